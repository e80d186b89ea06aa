"""One device of an emulated suit, as its firmware runs it. Sans-I/O: bytes and instants in, ``Timed`` frames
out.

``emulated_device`` is the whole of it: boots, reports, listens, obeys, loses power. It is made of ``sender``
(under which id and count it sends), ``sampling`` (when it takes samples), ``status_reports`` (what it says by
itself), ``command_responder`` (what it does when told, verb by verb) and what it keeps: ``emulated_flash``,
``emulated_card``. ``relay_device`` is the relay unit, a device that forwards others.

``firmware_memory`` is another's: the memory of the reference firmware, when that runs in place of these. A
new verb is a method of ``CommandResponder``.
"""
