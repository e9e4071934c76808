"""The command line: flags, files of settings, messages."""
