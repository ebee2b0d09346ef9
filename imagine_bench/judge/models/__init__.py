"""World models judged against the exact truth of the rules: what they imagine, how sure they are, what it costs."""
