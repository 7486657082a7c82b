"""The command line: thin commands; the only place that prints, catches errors and exits."""
