"""The science harness: trains, plans, tests and compares; where algorithm and task meet."""
