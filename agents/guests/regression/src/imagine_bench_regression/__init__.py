"""Chapter 4 of the thesis as a guest of imagine_bench: two regression tasks, and Bayesian mixture density networks."""
