"""How an emulated body moves: in closed form, so that orientations, rates and accelerations are exact.

``waves`` (sums of sines with a smooth fade-in) are the joint angles and the root's path; ``kinematics_truth``
makes the state of every segment of them; ``motions`` has the kinds of motion by name (``MOTIONS``) as
``BodyMotion``s. What needs feet is planned: ``legs`` (angles from where a foot is), ``stride`` (one published
stride), ``gait`` (feet that stand still), ``everyday`` (walks, turns, reaches, squats). For calibrations:
``calibrating``, ``tumbling``.

A new motion is a function that returns a ``BodyMotion``, and its line in ``MOTIONS``. World east-north-up; m,
s, rad.
"""
