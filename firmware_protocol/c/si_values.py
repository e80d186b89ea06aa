"""The header's conversions between steps on the wire and SI units, from declared layouts."""

from __future__ import annotations

from firmware_protocol.c.conversions import function
from firmware_protocol.c.records import Record, flag_macro, presence_macro, raw_limits
from firmware_protocol.c.spelling import C_TYPES, c_name, comment, literal
from firmware_protocol.fields import INTEGER_RANGE, MaskFlag, WireField


def si_source(record: Record) -> str:
    """Return conversions of every scaled field; for inertial readings also what sets a field as a whole."""
    parts = []
    for declared in record.layout.fields:
        if declared.scale is None:
            continue
        clipping = [flag for flag in record.layout.flags if flag.clips == declared.name]
        parts.append(_to_and_from(record, declared, bool(clipping)))
        parts += [_setters(record, declared, flag) for flag in clipping]
    return "\n\n".join(parts)


def _to_and_from(record: Record, declared: WireField, saturates: bool) -> str:
    c_type, name = C_TYPES[declared.code], c_name(record.name, declared.name)
    low, high = raw_limits(declared)
    if saturates:
        # Symmetric, as a clipped reading is sent with the largest number of either sign.
        low = -high
    sign = "signed" if INTEGER_RANGE[declared.code][0] < 0 else "unsigned"
    limits = f"{literal(low, declared.code)}, {literal(high, declared.code)}"
    to_si = f"(MOCAP_REAL)raw * {_scale(declared)}"
    from_si = f"({c_type})mocap_nearest_{sign}(value / {_scale(declared)}, {limits})"
    return "\n".join(
        [
            comment(f"Between steps and {declared.unit}; beyond what the field allows, its nearest end."),
            function(f"MOCAP_REAL {name}_to_si({c_type} raw)", [f"return {to_si};"]),
            "",
            function(f"{c_type} {name}_from_si(MOCAP_REAL value)", [f"return {from_si};"]),
        ]
    )


def _setters(record: Record, declared: WireField, flag: MaskFlag) -> str:
    """Return functions that set all components, from steps and from SI, and mark what is beyond the range."""
    name = c_name(record.name, "set", declared.name)
    note = (
        f"Puts a reading into a sample, in steps or in {declared.unit}; beyond the range as its end, clipped."
    )
    from_steps = _setter(record, declared, flag, "int32_t")
    from_si = _setter(record, declared, flag, "MOCAP_REAL")
    arguments = "{0} *packet, {1} x, {1} y, {1} z"
    return "\n".join(
        [
            comment(note),
            function(f"void {name}({arguments.format(record.c_type, 'int32_t')})", from_steps),
            "",
            function(f"void {name}_si({arguments.format(record.c_type, 'MOCAP_REAL')})", from_si),
        ]
    )


def _setter(record: Record, declared: WireField, flag: MaskFlag, given: str) -> list[str]:
    if declared.count != 3:
        raise ValueError(f"{record.name}.{declared.name}: what can be clipped has 3 components")
    has, clipped = presence_macro(record, declared), flag_macro(record, flag)
    c_type, limit = C_TYPES[declared.code], INTEGER_RANGE[declared.code][1]
    kept = f"({c_type})(v[i] < 0 ? -{limit} : {limit})"
    if given == "int32_t":
        outside = f"v[i] < -{limit}" + (f" || v[i] > {limit}" if limit < 2**31 - 1 else "")
        within = f"({c_type})v[i]"
    else:
        # Written so that "not a number" is outside.
        outside = f"!(v[i] > (MOCAP_REAL)-{limit}.5 && v[i] < (MOCAP_REAL){limit}.5)"
        within = f"({c_type})mocap_nearest_signed(v[i], -{limit}, {limit})"
    components = "x, y, z" if given == "int32_t" else ", ".join(f"{c} / {_scale(declared)}" for c in "xyz")
    return [
        f"const {given} v[3] = {{{components}}};",
        "size_t i;",
        f"packet->mask = (uint8_t)((packet->mask | {has}) & (0xFFu ^ {clipped}));",
        "for (i = 0; i < 3u; ++i) {",
        f"    if ({outside}) {{",
        f"        packet->mask = (uint8_t)(packet->mask | {clipped});",
        f"        packet->{declared.name}[i] = {kept};",
        "    } else {",
        f"        packet->{declared.name}[i] = {within};",
        "    }",
        "}",
    ]


def _scale(declared: WireField) -> str:
    return f"(MOCAP_REAL){declared.scale!r}"
