"""The pages of `invertwin reconstruct`: problem, fitting, scores, writing."""
