"""Learning: data sets at scale, and environments for Gymnasium.

Nothing else in the package imports this one; each half names the extra that it needs.
"""
