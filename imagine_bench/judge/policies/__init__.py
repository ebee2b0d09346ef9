"""Policies in a model and in the truth: does the model rank them, train better ones, and can it be exploited?"""
