"""Scene files of other renderers -> a configuration, with one line for every key of theirs."""
