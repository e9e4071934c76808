"""The command line: runs, their records and pictures. Uses `sqt_jax`; nothing imports it."""
