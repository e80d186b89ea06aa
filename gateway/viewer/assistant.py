"""The assistant on the page: which modules are heard, which one is which, and whose segment each is.

Every step asks the gateway the verbs that the terminal asks (``mocap-gateway modules``), over MQTT. Nothing
is written to a module before a switch says so.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import viser

from gateway.errors import GatewayError
from gateway.modules.assignment import Proposal, Wardrobe
from gateway.viewer.step_tab import COLOURS, NOTHING, Ask, StepTab, line, set_options, table
from gateway.viewer.texts import segment_name, translated

LISTEN_S, BLINK_S, SHAKEN_S = 2.0, 5, 20.0


class Assistant(StepTab):
    """One tab of the panel, and the others of the set-up, which speak its language."""

    def __init__(
        self,
        server: viser.ViserServer,
        tabs: viser.GuiTabGroupHandle,
        ask: Ask,
        marks: Callable[[str], None],
    ) -> None:
        """Add the tab; ``marks`` is called with the segment that is meant, to show it on the body."""
        super().__init__(server, tabs, "tab", ask)
        self._mark = marks
        self._listed: Mapping[str, Any] | None = None
        self._examined: Mapping[str, Any] | None = None
        self._others: list[StepTab] = []
        self.build()

    def leads(self, *tabs: StepTab) -> None:
        """Have other tabs speak the language that is chosen here."""
        self._others += tabs

    def choose_segment(self, segment: str) -> None:
        """Choose the segment of a limb that was clicked."""
        if segment in (self._listed or NO_MODULES)["segments"]:
            # the library's property has a setter, which the type checker does not see
            self._segment.value = segment_name(self._language, segment)  # type: ignore[misc]

    def set_language(self, language: str) -> None:
        """Say everything in that language from now on, on all tabs of the set-up."""
        chosen = self._chosen_device(), self._chosen_segment()
        super().set_language(language)
        self._show_listed(*chosen)
        for other in self._others:
            other.set_language(language)

    def _add_parts(self) -> list[Any]:
        gui = self._server.gui
        examine = self._button("examine", self._examine)
        self._findings = gui.add_html(
            "" if self._examined is None else findings(self._examined, self._language)
        )
        self._down = gui.add_dropdown(self._translated("link_down"), (NOTHING,), visible=False)
        self._port = gui.add_dropdown(self._translated("port"), (NOTHING,), visible=False)
        self._connect = self._button("connect", self._connect_port, visible=False)
        self._offer_ports()

        look = self._button("look", self._look)
        self._found = gui.add_html("")
        self._write = gui.add_checkbox(self._translated("write"), False)
        self._separate = self._button("separate", self._give_own_ids, visible=False)
        self._device = gui.add_dropdown(self._translated("device"), (NOTHING,))
        identify = self._button("identify", self._blink)
        hint = gui.add_html(line(self._translated("hint")))
        self._segment = gui.add_dropdown(self._translated("segment"), (NOTHING,))
        self._segment.on_update(lambda _: self._mark(self._chosen_segment()))
        shake = self._button("shake", self._await_shake)
        assign, undo = self._button("assign", self._assign), self._button("undo", self._undo)
        # These are shown only once modules were heard: before, they would offer what cannot work.
        self._device_parts = [self._found, self._write, self._device, identify, hint]
        self._device_parts += [self._segment, shake, assign, undo]
        self._show_listed("", "")
        return [
            *(examine, self._findings, self._down, self._port, self._connect),
            *(look, self._separate, *self._device_parts),
        ]

    async def _examine(self) -> str:
        self._show_text(self._translated("examining"))
        self._examined = await self._ask("gateway", "examine", {})
        self._findings.content = findings(self._examined, self._language)
        self._findings.visible = True
        self._offer_ports()
        verdicts = [one["verdict"] for one in self._examined["findings"]]
        bad, warnings = verdicts.count("bad"), verdicts.count("warning")
        return (
            self._translated("examined", bad=bad, warnings=warnings)
            if bad or warnings
            else self._translated("all_well")
        )

    def _offer_ports(self) -> None:
        """Show the choice of a port where a link has none that is there, and one is free."""
        examined = self._examined or {}
        down = examined.get("links_down", ())
        free = [port["name"] for port in examined.get("ports", ()) if port["link"] is None]
        is_of_use = bool(down and free)
        if is_of_use:
            self._down.options, self._port.options = tuple(down), tuple(free)
        for part in (self._down, self._port, self._connect):
            part.visible = is_of_use

    async def _connect_port(self) -> str:
        answer = await self._ask("gateway", "connect", {"link": self._down.value, "port": self._port.value})
        return self._translated("connected", link=answer["link"], url=answer["url"])

    async def _look(self) -> str:
        self._show_text(self._translated("looking"))
        listed = await self._ask("modules", "list", {"listen_s": LISTEN_S})
        chosen = self._chosen_device(), self._chosen_segment()
        self._listed = listed
        self._show_listed(*chosen)
        count = len(self._listed["modules"])
        return self._translated("heard", count=count) if count else self._translated("nobody")

    def _show_listed(self, device: str, segment: str) -> None:
        """Show what is heard, and what can be done with it: nothing before it is looked for.

        device, segment: to be chosen, by unique id and by the body's name of it; empty: none.
        """
        listed = self._listed
        for part in self._device_parts:
            part.visible = listed is not None
        if listed is None:
            return
        self._findings.visible = False  # whoever has gone on would have to scroll past them
        self._found.content = found_table(listed, self._language)
        self._separate.visible = bool(listed["conflicts"])
        devices = devices_of(listed, self._language)
        label = next((label for label, unique_id in devices.items() if unique_id == device), None)
        set_options(self._device, (NOTHING, *devices), label)
        names = tuple(segment_name(self._language, name) for name in listed["segments"])
        set_options(self._segment, (NOTHING, *names), segment_name(self._language, segment))

    def _chosen_device(self) -> str:
        """Return the unique id of the module that is chosen; empty: none is."""
        return devices_of(self._listed or NO_MODULES, self._language).get(self._device.value, "")

    def _chosen_segment(self) -> str:
        """Return the name of the chosen segment in the body, or an empty text."""
        segments = (self._listed or NO_MODULES)["segments"]
        named: dict[str, str] = {segment_name(self._language, name): name for name in segments}
        return named.get(self._segment.value, "")

    async def _blink(self) -> str:
        if not (device := self._chosen_device()):
            return self._translated("first_choose")
        answer = await self._ask("modules", "identify", {"device": device, "seconds": BLINK_S})
        return self._translated("blinks", id=answer["module"])

    async def _await_shake(self) -> str:
        self._show_text(self._translated("waiting"))
        answer = await self._ask("modules", "motion", {"seconds": SHAKEN_S})
        if answer["module"] is None:
            return self._translated("none_moved")
        device = str(answer["unique_id"])
        # A device that was switched on after the last look is not in the list yet.
        if device not in devices_of(self._needed(), self._language).values():
            await self._look()
        self._show_listed(device, self._chosen_segment())
        return self._translated("moved", id=answer["module"])

    async def _assign(self) -> str:
        listed = self._needed()
        device, segment = self._chosen_device(), self._chosen_segment()
        if not (device and segment):
            return self._translated("first_choose_both")
        if listed["conflicts"]:
            return self._conflicts()[0]
        proposal = Wardrobe(listed).propose(segment, device)
        what = proposal_text(proposal, self._language)
        if proposal.is_right_already:
            return what
        if refused := self._unwritable(what, "assign"):
            return refused
        await self._ask("modules", "assign", {"ids": proposal.ids})
        await self._look()
        self._show_listed("", "")  # the next one is chosen from scratch, and no name stays on the body
        return self._translated("written", what=what)

    async def _give_own_ids(self) -> str:
        shared = ", ".join(str(one["module"]) for one in self._needed()["conflicts"])
        if refused := self._unwritable(self._translated("would_separate", ids=shared), "separate"):
            return refused
        answer = await self._ask("modules", "separate", {})
        await self._look()
        return self._translated("separated", count=len(answer["changes"]))

    async def _undo(self) -> str:
        if refused := self._unwritable(self._translated("undo"), "undo"):
            return refused
        answer = await self._ask("modules", "undo", {})
        await self._look()
        failures = [f"…{uid[-6:]}: {why}" for uid, why in answer["failures"].items()]
        failures += [f"…{uid[-6:]}: {self._translated('silent')}" for uid in answer["absent"]]
        if failures:
            return self._translated(
                "undone_partly", count=len(answer["changes"]), failures="; ".join(failures)
            )
        return self._translated("undone", count=len(answer["changes"]))

    def _unwritable(self, what: str, button: str) -> str | None:
        """Return why nothing may be written, or None; ``button`` is the key of its text."""
        if not self._needed()["allows_writes"]:
            return self._translated("refused")
        if self._write.value:
            return None
        return self._translated(
            "first_write", what=what, write=self._translated("write"), button=self._translated(button)
        )

    def _conflicts(self) -> list[str]:
        return conflict_lines(self._needed(), self._language)

    def _needed(self) -> Mapping[str, Any]:
        if self._listed is None:
            raise GatewayError(self._translated("first_look"))
        return self._listed


NO_MODULES: Mapping[str, Any] = {"modules": (), "segments": {}}
"""What is known of modules before they are looked for."""


def devices_of(listed: Mapping[str, Any], language: str) -> dict[str, str]:
    """Return the unique ids of devices that can be asked, by label: id, segment, end of the unique id."""
    return {
        f"{one['module']} · {segment_name(language, one['segment'] or NOTHING)} · …{one['unique_id'][-6:]}": (
            one["unique_id"]
        )
        for one in listed["modules"]
        if one["answers"] and one["unique_id"]
    }


def proposal_text(proposal: Proposal, language: str) -> str:
    """Return what an assignment would write."""
    segment = segment_name(language, proposal.segment)
    if proposal.is_right_already:
        return translated(language, "right", segment=segment, id=proposal.after)
    key = "exchange" if proposal.displaced else "becomes"
    return translated(language, key, segment=segment, before=proposal.before, after=proposal.after)


def conflict_lines(listed: Mapping[str, Any], language: str) -> list[str]:
    """Return a line for each id that several modules have."""
    return [
        translated(
            language,
            "conflict",
            count=len(one["unique_ids"]),
            id=one["module"],
            which=", ".join(f"…{unique_id[-6:]}" for unique_id in one["unique_ids"]),
            separate=translated(language, "separate"),
        )
        for one in listed["conflicts"]
    ]


def found_table(listed: Mapping[str, Any], language: str) -> str:
    """Return the answer of ``modules list`` as HTML: devices, conflicts, and segments without a device."""
    keys = ["id", "segment", "battery", "rate", "lost", "clock"]
    if any(one.get("rssi_dbm") is not None for one in listed["modules"]):
        keys.append("signal")
    rows = [("inherit", _cells(one, language)[: len(keys)]) for one in listed["modules"]]
    lines = conflict_lines(listed, language)
    listed_segments = {one["segment"] for one in listed["modules"]}
    if silent := [segment_name(language, name) for name in listed["segments"] if name not in listed_segments]:
        lines.append(translated(language, "missing", segments=", ".join(silent)))
    alarms = "".join(
        f'<div style="color:var(--mocap-poor);font-weight:600;padding:3px 4px">{html.escape(line)}</div>'
        for line in lines
    )
    return f'<div style="padding:0 8px;font-size:11px">{alarms}</div>' + table(
        [translated(language, key) for key in keys], rows
    )


def _cells(one: Mapping[str, Any], language: str) -> Sequence[str]:
    clock, loss, signal = one.get("clock"), one.get("loss_percent"), one.get("rssi_dbm")
    return (
        str(one["module"]),
        segment_name(language, one["segment"] or NOTHING),
        "" if one.get("battery_percent") is None else f"{one['battery_percent']}\u00a0%",
        f"{one['rate_hz']:.0f}" if one["answers"] else translated(language, "silent"),
        "" if loss is None else f"{loss:.1f}",
        "" if clock is None else f"{clock['residual_us'] * 1e-3:.1f}",
        "" if signal is None else str(signal),
    )


def findings(examined: Mapping[str, Any], language: str) -> str:
    """Return the answer of ``gateway/examine`` as HTML: ports, then findings, worst first."""
    ports = [
        ("inherit", (port["name"], port["link"] or translated(language, "unused")))
        for port in examined["ports"]
    ]
    found = sorted(examined["findings"], key=lambda one: ("bad", "warning", "good").index(one["verdict"]))
    text = "".join(_finding(one) for one in found if one["verdict"] != "good")
    if good := [_finding(one) for one in found if one["verdict"] == "good"]:
        summary = translated(language, "are_well", count=len(good))
        text += f"<details><summary>{summary}</summary>{''.join(good)}</details>"
    return (
        table((translated(language, "ports"), ""), ports)
        + f'<div style="padding:4px 12px;font-size:11px;overflow-wrap:anywhere">{text}</div>'
    )


def _finding(one: Mapping[str, Any]) -> str:
    remedy = f"<br>→ {html.escape(one['remedy'])}" if one["remedy"] else ""
    return (
        f'<div style="padding:2px 0;color:{COLOURS[one["verdict"]]}"><b>{html.escape(one["subject"])}</b>: '
        f"{html.escape(one['found'])}{remedy}</div>"
    )
