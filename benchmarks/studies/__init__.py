"""Studies beside the preset's runs, each a client of the rooms above."""
