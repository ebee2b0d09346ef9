"""Networks and optimisers that the learners share."""
