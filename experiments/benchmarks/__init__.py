"""The measurements of `experiments.bench`, one module per part, and the comparison with other implementations."""
