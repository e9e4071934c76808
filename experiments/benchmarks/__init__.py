"""What `experiments.bench` measures, part by part, and the peers that it can be measured beside."""
