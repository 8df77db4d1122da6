"""The commands of the command line: each translates arguments and calls a function that can be imported."""
