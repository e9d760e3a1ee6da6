"""What others take away: data sets of the task."""
