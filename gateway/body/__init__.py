"""What is worn: the person or machine as segments and joints, and which module sits where.

Files first, then what the program works with: ``settings_files`` reads YAML into entries, entries become
frozen data, and nothing changes it while the gateway runs.

- ``body_file`` (segments, joints, the world) → ``skeleton`` (with ``joints``, markers, ``camera``).
- ``rig`` (modules on segments, with ``sensor_entries`` for their calibrations) → ``skeleton.WornSuit``,
  which all that reconstructs takes; ``subject_file`` adds what was measured of one person.
- ``anthropometry`` fits a body to a person; ``inertia`` gives its masses.
- Poses of a body: ``kinematics`` (where the joints are), ``interpolation`` (segments without module),
  ``joint_angles``.
- Its looks: ``bones``, ``mannequin``. Other machines: ``urdf`` → ``robot`` → ``retargeting``.

A new body is a file in ``config/bodies/``, not code. A new property of one is an entry in ``body_file``, a
field of ``Skeleton``, and a line in ``skeleton_of``. Units: m, rad, kg; segment axes as in
docs/reference/conventions.md.
"""
