"""What emulated sensors read: the true motion, what is wrong with it, and the bytes of it.

``ideal_sensors`` (what perfect ones would read) → ``disturbances`` (a tap, a shake) → ``inertial_sampler``,
``local_sampler``, ``light_sampler`` (noise, biases, clipping as ``devices.emulators.imperfections`` has
them) → ``sample_encoding`` (bodies of packets). A new kind of sensor is a sampler here, made in
``suit_settings`` or ``suit_traffic``. SI, sensor axes.
"""
