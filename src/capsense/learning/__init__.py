"""Learning: data sets at scale, environments for Gymnasium, the pose of a limb, sensors for a task.

Nothing else in the package but the command line imports this one; data sets and environments name
the extra that they need, the rest needs none.
"""
