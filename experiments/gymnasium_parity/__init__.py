"""What `experiments.parity` compares with: Gymnasium's own environments, step by step and in distribution."""
