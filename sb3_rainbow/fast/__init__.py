"""The compiled CPU path: everything works without this folder, slower."""
