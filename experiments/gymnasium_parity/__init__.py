"""Our environments against Gymnasium's own, step by step and in distribution: the parts of `experiments.parity`."""
