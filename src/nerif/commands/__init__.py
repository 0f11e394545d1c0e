"""One file a verb of the command line: a record of its settings, and what it does."""
