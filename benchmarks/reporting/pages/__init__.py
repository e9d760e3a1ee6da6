"""README's results, and pages that hold whole files of results/."""
