"""The overview as a page: a table of all gateways that renews itself, each with a link to its body.

The server stands behind the gate of the body's page (``gateway.viewer.gate``), which decides who may come in.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
from collections import OrderedDict
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from devices.free_ports import free_port
from gateway.outputs.settings import PASSWORD_VARIABLE, MqttSettings
from gateway.support.credentials import AccessToken
from gateway.viewer.gate import PASS_HEADER

MOST_BODIES = 4
"""Pages of bodies at one time; for one more the oldest is closed."""
_PATIENCE_S = 3.0
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'"

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Fleet</title><style>
:root{color-scheme:light dark;--ink:#1b1f24;--soft:#57606a;--paper:#fff;--line:#d5d9de;--warn:#fff1e5;
 --bad:#b00020;--good:#0a6b2d;--link:#0550ae}
@media(prefers-color-scheme:dark){:root{--ink:#e6e9ec;--soft:#9aa4ae;--paper:#15181c;--line:#353b42;
 --warn:#3b2614;--bad:#ff8a80;--good:#7ddc94;--link:#8ab8ff}}
body{font:15px system-ui,sans-serif;margin:1.5rem;background:var(--paper);color:var(--ink)}
h1{font-size:1.3rem;margin:0 0 .3rem}#sum{margin:0 0 1rem}a{color:var(--link)}
table{border-collapse:collapse;width:100%}
th,td{text-align:left;padding:.3rem .6rem;border-bottom:1px solid var(--line);vertical-align:top}
td:first-child{min-width:10rem;overflow-wrap:anywhere}td:last-child{min-width:12rem}
th{position:sticky;top:0;background:var(--paper);white-space:nowrap}
.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
tr.alert{background:var(--warn)}.offline{color:var(--bad)}.online{color:var(--good)}
@media(max-width:60rem){body{margin:1rem}
 thead{position:absolute;clip-path:inset(50%)}table,tbody{display:block}
 tr{display:grid;grid-template-columns:repeat(auto-fill,minmax(4.5rem,1fr));gap:.3rem .6rem;
  padding:.6rem;border-bottom:1px solid var(--line)}
 td,td.n{border:0;padding:0;text-align:left;overflow-wrap:anywhere}
 td::before{content:attr(data-head);display:block;font-size:.75rem;color:var(--soft)}
 td:first-child,td:last-child{grid-column:1/-1}td:nth-child(2){grid-column:span 2}
 td:first-child{font-weight:600}
 td:first-child::before,td:empty{display:none}}
</style></head><body><h1>Fleet</h1><p id="sum" role="status">reading …</p>
<table><thead><tr><th>gateway<th>wearer<th>state<th class="n">poses/s<th class="n">loss<th class="n">delay ms
<th class="n">lost<th class="n">late<th class="n">free GB<th>version<th>firmware<th>alerts</tr></thead>
<tbody id="rows"></tbody></table><script>
const heads=[...document.querySelectorAll("th")],sum=document.getElementById("sum")
const body=document.getElementById("rows"),shown=new Map()
const put=(place,text)=>{if(place.textContent!==text)place.textContent=text}
function rowOf(name){let tr=shown.get(name);if(tr)return tr
 tr=document.createElement("tr");shown.set(name,tr)
 for(const th of heads){const td=tr.insertCell()
  td.dataset.head=th.textContent.trim();td.className=th.className}
 const a=document.createElement("a");a.textContent=name;a.target="_blank";a.rel="noopener"
 a.href="body?gateway="+encodeURIComponent(name);tr.cells[0].append(a);return tr}
function show(g,at){const tr=rowOf(g.gateway),[,...cells]=tr.cells
 const texts=[g.wearer,g.state,g.rate_hz.toFixed(1),(100*g.loss).toFixed(1)+" %",g.delay_ms?.toFixed(0),
  g.lost,g.late,g.free_gb?.toFixed(0),g.version,g.firmware.join(", ")||null,g.alerts.join("; ")]
 cells.forEach((td,i)=>put(td,String(texts[i]??"–")))
 cells[1].className=g.state;tr.className=g.alerts.length?"alert":""
 if(body.rows[at]!==tr)body.insertBefore(tr,body.rows[at]??null)}
async function renew(){try{
 const report=await(await fetch("fleet.json",{cache:"no-store"})).json()
 const there=new Set(report.map(g=>g.gateway))
 for(const [name,tr] of shown)if(!there.has(name)){tr.remove();shown.delete(name)}
 report.forEach(show)
 const bad=report.filter(g=>g.alerts.length).length,up=report.filter(g=>g.state=="online").length
 put(sum,`${report.length} gateways, ${up} online, ${bad} with alerts`)
}catch(e){put(sum,"the overview does not answer")}setTimeout(renew,1000)}
renew()</script></body></html>
"""


class Bodies:
    """Pages of single bodies, each a ``mocap-gateway view`` of its own."""

    def __init__(self, settings: MqttSettings) -> None:
        self._settings = settings
        self._open: OrderedDict[str, tuple[int, subprocess.Popen[bytes]]] = OrderedDict()
        self._lock = threading.Lock()

    def port_of(self, gateway: str) -> int:
        """Return the port of a gateway's page, which is started if it does not run."""
        with self._lock:
            running = self._open.pop(gateway, None)
            if running is None or running[1].poll() is not None:
                running = self._start(gateway)
            self._open[gateway] = running
            while len(self._open) > MOST_BODIES:
                _, (_, oldest) = self._open.popitem(last=False)
                oldest.terminate()
            return running[0]

    def _start(self, gateway: str) -> tuple[int, subprocess.Popen[bytes]]:
        port = free_port()
        settings = self._settings
        arguments = ["--host", settings.host, "--port", str(settings.port), "--gateway", gateway]
        arguments += [f"--failover={address}" for address in settings.failover]
        arguments += ["--base-topic", settings.base_topic, "--protocol", settings.protocol]
        arguments += ["--page-port", str(port), "--wait"]
        if settings.username is not None:
            arguments += ["--username", settings.username]
        if settings.tls is not None and settings.tls.ca_file is not None:
            arguments += ["--ca-file", str(settings.tls.ca_file)]
        password = settings.read_password()
        environment = dict(os.environ) | ({} if password is None else {PASSWORD_VARIABLE: password})
        command = [sys.executable, "-m", "gateway", "view", *arguments]
        return port, subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)

    def close(self) -> None:
        """End all of them."""
        for _, process in self._open.values():
            process.terminate()
        for _, process in self._open.values():
            process.wait()


class OverviewServer:
    """Serves page and rows on a free port of loopback, to its gate alone. Belongs to one event loop."""

    def __init__(
        self, rows: Callable[[], list[dict[str, Any]]], bodies: Bodies, gate_pass: AccessToken
    ) -> None:
        self.gate_pass = gate_pass
        self._rows = rows
        self._bodies = bodies
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server: ThreadingHTTPServer | None = None

    @property
    def port(self) -> int:
        """Where it listens."""
        assert self._server is not None
        return int(self._server.server_address[1])

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows as the event loop has them now."""
        assert self._loop is not None

        async def ask() -> list[dict[str, Any]]:
            return self._rows()

        return asyncio.run_coroutine_threadsafe(ask(), self._loop).result(_PATIENCE_S)

    def body(self, gateway: str) -> int | None:
        """Return the port of a gateway's page; None: nobody has heard of it."""
        if all(row["gateway"] != gateway for row in self.rows()):
            return None
        return self._bodies.port_of(gateway)

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        handler = type("Handler", (_Handler,), {"owner": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=self._server.serve_forever, args=(0.1,), name="overview", daemon=True).start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._server is not None
        await asyncio.to_thread(self._server.shutdown)
        self._server.server_close()
        await asyncio.to_thread(self._bodies.close)


class _Handler(BaseHTTPRequestHandler):
    owner: OverviewServer
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        """Answer one request."""
        path, _, query = self.path.partition("?")
        if not self.owner.gate_pass.matches(", ".join(self.headers.get_all(PASS_HEADER, []))):
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", "the page is served through its gate only\n")
        elif path == "/":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", PAGE)
        elif path == "/fleet.json":
            self._answer(HTTPStatus.OK, "application/json", json.dumps(self.owner.rows()))
        elif path == "/body":
            self._body(query)
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", "there is / and /fleet.json\n")

    def _body(self, query: str) -> None:
        (gateway, *_) = urllib.parse.parse_qs(query).get("gateway", [""])
        port = self.owner.body(gateway)
        if port is None:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", "no gateway of that name has been heard\n")
            return
        name = (self.headers.get("Host") or "127.0.0.1").rpartition(":")[0] or "127.0.0.1"
        self._await(port)
        self.send_response(HTTPStatus.SEE_OTHER)
        self.send_header("Location", f"http://{name}:{port}/")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _await(self, port: int) -> None:
        """Wait until the page of a body listens, or for so long that its own error is the better answer."""
        deadline = time.monotonic() + 10 * _PATIENCE_S
        while time.monotonic() < deadline:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
            except OSError:
                time.sleep(0.1)
            else:
                return

    def _answer(self, status: HTTPStatus, kind: str, text: str) -> None:
        content = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", f"{_POLICY}; frame-ancestors 'none'")
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the library's name
        """Say nothing: a page asks every second."""
