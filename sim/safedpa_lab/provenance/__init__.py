"""Where a figure comes from: the command, seeds, date, commit and code behind each file of results."""
