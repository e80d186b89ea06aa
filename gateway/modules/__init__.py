"""What people do with the modules of a suit: list, identify, assign, set, back up, fetch from the card.

Every action is a verb with a request and an answer in plain JSON values, so that the command line does
the same whether it reads the suit itself or asks a running gateway over MQTT. Reading order: ``verbs``
(what may be asked), ``operations`` (what is done), ``motion`` (which module was shaken), ``journal``
(what stood there before), ``session`` (a suit read by this process), ``remote`` (one read by a gateway).
"""
