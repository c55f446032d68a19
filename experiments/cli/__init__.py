"""The command line: options, what they do, and exit codes."""
