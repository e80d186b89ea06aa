"""The live 3-D page: a body that moves, in any browser, fed by the broker like every other app.

It subscribes, so it can run on another machine than the gateway, and nothing that it does can delay
sensing. Reading order: ``bones`` (what a body looks like), ``appearance`` (colours), ``stage`` and
``scene`` (both on the page), ``panel`` (texts, plots, buttons), ``live`` (from the broker), ``playback``
(from a recording). The page itself comes from the library viser (extra ``viewer``), which loads nothing from
elsewhere.
"""
