"""What others take away: data sets of the task, and trained policies as packages."""
