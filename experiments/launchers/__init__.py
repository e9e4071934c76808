"""Where the runs of a grid are started: in processes here, on SLURM or on Ray. One interface, a file each."""
