"""One update of Rainbow, in plain torch."""
