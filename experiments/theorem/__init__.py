"""Section 5 of the paper on small MDPs: tabular agents, the contraction of eq. 16, and the verdicts on the claims."""
