"""Rotations and vectors as kernels, the one way in which kernels are compiled, and errors of orientations.

``quaternion`` (Hamilton, w first), ``rotation_matrix``, ``vectors`` and ``derivatives`` are what equations
are written with. ``compiled`` is the decorator of every kernel of the gateway: it keeps machine code on the
disk under the ``kernel_fingerprint``. ``records`` declares structured state that kernels address by name.
``comparison`` says how far orientations are from a reference.

Names of rotations cancel: ``q_ab`` takes coordinates in frame b to frame a, so ``q_ac = q_ab ⊗ q_bc``.
"""
