"""The surface solver: charges on bodies against the Green's function of a design.

Its packages are the stages of a step, in order: ``bodies`` (shapes as panels), ``tree`` (clusters
of panels, charge functions and their potential coefficients), ``gap`` (what is nearer than the
Green's function resolves), ``selection`` (which clusters a scene needs), ``placement`` (where these
are), ``interaction`` (what they meet), ``system`` (the equations and their solution) and
``gradients``.
"""
