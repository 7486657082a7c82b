"""What ``import nlosrender`` offers to Python and notebooks; the command line calls the same functions."""
