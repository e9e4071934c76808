"""The guard around every command: what the user's shell, streams, home folder and job may be, no run is lost by it.

variables.py     environment variables, changed before libraries read them
streams.py       standard output that may be full, closed or ASCII
consoles.py      rich consoles, as wide as their tables in files and pipes
paths.py         `~` in flags and variables
jax_settings.py  JAX's switches, compilation cache and devices
gpu_options.py   XLA's options for GPUs, all off
"""
