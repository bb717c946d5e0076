"""The command line: subcommands, the choice of a device, everything that is printed.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 bad input, 2 wrong usage, 130 interrupted.
"""

INTERRUPTED = 130
STOPPED = "interrupted; nothing was left half-written"
