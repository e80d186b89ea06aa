"""What goes wrong, on purpose: with an emulated suit while it runs, and with bytes that decoders are given.

A suit: ``fault_plan`` (what, when: ``emulate --faults FILE``) and ``faulty_suit``, which has it befall
modules, sensors and link. A new fault is a class in ``fault_plan``, and where it takes effect in
``faulty_suit``.

Decoders: ``wire_campaign`` (``wire_damage`` of our own protocol) and ``makers_campaign`` (those of other
makers) damage traffic at random; nothing may raise, and nothing false may pass.
"""
