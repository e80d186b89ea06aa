"""Where skeleton frames go: MQTT, and beside it VMC, UDP and LSL.

``mqtt.MqttOutput`` publishes them, ``PoseSubscriber`` receives them; ``messages`` declares every payload
and ``topics`` where it is published. Reading order: ``messages``, ``topics``, ``settings``,
``mqtt``, ``connection``, ``pose_encoding``, ``queues``, ``subscriber``, ``broker_process``; then
``side_outputs``, ``unity``.
"""
