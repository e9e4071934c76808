"""Section 5 of the paper on small MDPs: the tabular agents, the contraction of eq. 16, and what is said of them."""
