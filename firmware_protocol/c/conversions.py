"""Encoders and decoders of the header's structs, from declared layouts."""

from __future__ import annotations

from collections.abc import Iterator

from firmware_protocol.c.records import Record, flag_macro, presence_macro, raw_limits
from firmware_protocol.c.spelling import c_name, comment, literal, macro_name, type_suffix, wrapped
from firmware_protocol.fields import INTEGER_RANGE, WireField

_INDENT = "    "


def conversion_source(record: Record) -> str:
    """Return the size, validity, encoder and decoder of a record."""
    parts = [_mask_size(record), validity_source(record), _encoder(record), _decoder(record)]
    return "\n\n".join(part for part in parts if part)


def put_lines(declared: WireField, value: str, size: str = "") -> list[str]:
    """Return statements that write a field at ``p``; ``value`` is the expression of the whole field."""
    if declared.code == "s":
        return [f"p = mocap_put_bytes(p, {value}, {size or f'{declared.count}u'});"]
    put = f"mocap_put_{type_suffix(declared)}"
    if declared.count == 1:
        return [f"p = {put}(p, {value});"]
    return [f"for (i = 0; i < {declared.count}u; ++i) {{", f"    p = {put}(p, {value}[i]);", "}"]


def get_lines(declared: WireField, target: str) -> list[str]:
    """Return statements that read a field at ``p`` into ``target`` and move ``p`` past it."""
    if declared.code == "s":
        return [f"memcpy({target}, p, {declared.count}u);", f"p += {declared.count}u;"]
    get, step = f"mocap_get_{type_suffix(declared)}(p)", f"p += {declared.size // declared.count}u;"
    if declared.count == 1:
        return [f"{target} = {get};", step]
    return [f"for (i = 0; i < {declared.count}u; ++i) {{", f"    {target}[i] = {get};", f"    {step}", "}"]


def refusals(declared: WireField, element: str) -> list[str]:
    """Return conditions, any of which makes an element no value of the field."""
    if declared.code == "f":
        limits = [f"{element} < {declared.minimum!r}f"] if declared.minimum is not None else []
        limits += [f"{element} > {declared.maximum!r}f"] if declared.maximum is not None else []
        return [f"!mocap_is_finite({element})", *limits]
    if declared.code == "s" or not declared.is_restricted:
        return []
    numbers = sorted(declared.meanings)
    if numbers and numbers != list(range(numbers[0], numbers[-1] + 1)):
        return ["(" + " && ".join(f"{element} != {literal(n, declared.code)}" for n in numbers) + ")"]
    low, high = (numbers[0], numbers[-1]) if numbers else raw_limits(declared)
    outside = []
    # A comparison that can never be true would be a warning.
    if low > INTEGER_RANGE[declared.code][0]:
        outside.append(f"{element} < {literal(low, declared.code)}")
    if high < INTEGER_RANGE[declared.code][1]:
        outside.append(f"{element} > {literal(high, declared.code)}")
    if declared.absent is None or not outside:
        return outside
    return [f"({element} != {literal(declared.absent, declared.code)} && ({' || '.join(outside)}))"]


def text_refusal(declared: WireField, value: str, size: str) -> list[str]:
    """Return the condition that makes bytes no text, where the field is text."""
    if not declared.is_text:
        return []
    return [f"!mocap_is_{'text' if declared.is_rest else 'padded_text'}({value}, {size})"]


def function(head: str, body: list[str]) -> str:
    """Return a function of the header, its body indented."""
    lines = [f"static inline {head} {{", *(_INDENT + line for line in body), "}"]
    return "\n".join(piece for line in lines for piece in wrapped(line))


def loops_over(fields: list[WireField]) -> bool:
    """Return whether statements over these fields need an index."""
    return any(f.count > 1 and f.code != "s" for f in fields)


def _mask_size(record: Record) -> str:
    if not record.layout.has_mask:
        return ""
    used = 0
    body = []
    orphans = []
    for flag in record.layout.flags:
        used |= 1 << flag.bit
        if flag.clips:
            present = macro_name(record.name, "has", flag.clips)
            orphans.append(f"((mask & {flag_macro(record, flag)}) != 0u && (mask & {present}) == 0u)")
    for declared in record.layout.fields:
        if declared.presence_bit is not None:
            used |= 1 << declared.presence_bit
            body.append(f"size += (mask & {presence_macro(record, declared)}) != 0u ? {declared.size}u : 0u;")
    fixed = 1 + sum(f.size for f in record.layout.fields if f.presence_bit is None)
    reserved = [f"(mask & 0x{0xFF & ~used:02X}u) != 0u"] if used != 0xFF else []
    refused = " || ".join(reserved + orphans)
    lines = [f"size_t size = {fixed}u;", *return_if(refused, "0u"), *body, "return size;"]
    note = comment("Bytes that a mask demands; 0 for one that must not be used.")
    return note + "\n" + function(f"size_t {record.c_type}_size(uint8_t mask)", lines)


def validity_source(record: Record) -> str:
    """Return the function that checks whether every field has an allowed value; empty when all values are."""
    restricted = [f for f in record.layout.fields if f.is_restricted]
    if not restricted:
        return ""
    lines = ["size_t i;"] if loops_over(restricted) else []
    for declared in restricted:
        value = f"packet->{declared.name}"
        size = f"{value}_size" if declared.is_rest else f"{declared.count}u"
        text = text_refusal(declared, value, size)
        if declared.count > 1 and not text:
            lines.append(f"for (i = 0; i < {declared.count}u; ++i) {{")
            inner = return_if(" || ".join(refusals(declared, f"{value}[i]")), "false")
            lines += [*(_INDENT + line for line in inner), "}"]
        else:
            lines += return_if(" || ".join(text or refusals(declared, value)), "false")
    lines.append("return true;")
    return (
        comment("Whether every field has a value that it allows.")
        + "\n"
        + function(f"bool {record.c_type}_is_valid(const {record.c_type} *packet)", lines)
    )


def _encoder(record: Record) -> str:
    layout, rest = record.layout, record.layout.rest
    size = f"{record.c_type}_size(packet->mask)" if layout.has_mask else f"{layout.sizes()[0]}u"
    if rest:
        size = f"{layout.sizes()[0] - rest.min_size}u + packet->{rest.name}_size"
    refused = ["size > capacity"]
    if layout.has_mask:
        refused.insert(0, "size == 0u")
    if any(f.is_restricted for f in layout.fields):
        refused.append(f"!{record.c_type}_is_valid(packet)")
    lines = [f"const size_t size = {size};", "uint8_t *p = body;", *_index(record)]
    if rest:
        lines += return_if(" || ".join(_rest_refusals(rest, f"packet->{rest.name}_size")), "0u")
    lines += return_if(" || ".join(refused), "0u")
    if layout.has_mask:
        lines.append("p = mocap_put_u8(p, packet->mask);")
    for declared in layout.fields:
        value = f"packet->{declared.name}"
        lines += _if_present(
            record, declared, put_lines(declared, value, f"{value}_size" if declared.is_rest else "")
        )
    lines.append("return (size_t)(p - body);")
    name = c_name("encode", record.name)
    return function(f"size_t {name}(const {record.c_type} *packet, uint8_t *body, size_t capacity)", lines)


def _decoder(record: Record) -> str:
    layout, rest = record.layout, record.layout.rest
    lines = ["const uint8_t *p = body;", *_index(record), *_length_check(record)]
    lines.append("memset(packet, 0, sizeof *packet);")
    if layout.has_mask:
        lines += ["packet->mask = *p++;"]
    for declared in layout.fields:
        if not declared.is_rest:
            lines += _if_present(record, declared, get_lines(declared, f"packet->{declared.name}"))
    if rest:
        lines += [f"packet->{rest.name} = p;", f"packet->{rest.name}_size = size - (size_t)(p - body);"]
    else:
        lines.append("(void)p;")
    if any(f.is_restricted for f in layout.fields):
        lines.append(f"return {record.c_type}_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;")
    else:
        lines.append("return MOCAP_GOOD;")
    name = c_name("decode", record.name)
    return function(f"mocap_defect {name}(const uint8_t *body, size_t size, {record.c_type} *packet)", lines)


def _length_check(record: Record) -> list[str]:
    layout = record.layout
    if layout.has_mask:
        size = f"{record.c_type}_size(body[0])"
        return [
            *return_if("size == 0u", "MOCAP_BAD_LENGTH"),
            *return_if(f"{size} == 0u", "MOCAP_BAD_VALUE"),
            *return_if(f"size != {size}", "MOCAP_BAD_LENGTH"),
        ]
    low, high = layout.sizes()
    if low == high:
        return return_if(f"size != {low}u", "MOCAP_BAD_LENGTH")
    smaller = [f"size < {low}u"] if low else []
    return return_if(" || ".join([*smaller, f"size > {high}u"]), "MOCAP_BAD_LENGTH")


def _rest_refusals(rest: WireField, size: str) -> Iterator[str]:
    if rest.min_size:
        yield f"{size} < {rest.min_size}u"
    if rest.max_size is not None:
        yield f"{size} > {rest.max_size}u"


def _if_present(record: Record, declared: WireField, lines: list[str]) -> list[str]:
    if declared.presence_bit is None:
        return lines
    head = f"if ((packet->mask & {presence_macro(record, declared)}) != 0u) {{"
    return [head, *(_INDENT + line for line in lines), "}"]


def _index(record: Record) -> list[str]:
    return ["size_t i;"] if loops_over(list(record.layout.fields)) else []


def return_if(condition: str, value: str) -> list[str]:
    """Return statements that return where a condition holds."""
    return [f"if ({condition}) {{", f"    return {value};", "}"]
