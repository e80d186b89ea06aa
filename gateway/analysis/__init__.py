"""From recorded motion to joint torques, muscle tensions and what shows them.

``smooth_motion`` makes all degrees of freedom smooth functions of time; ``inertia`` gives the body mass;
``body_model`` and ``inverse_dynamics`` find the moments that the motion takes; ``plates`` and ``contact`` say
what the floor does; ``muscle_model`` and ``tension`` share the moments out among muscles. ``analysing`` joins
them; ``tables``, ``page`` and ``film`` write what came of it. Needs the extra ``biomech``.
"""
