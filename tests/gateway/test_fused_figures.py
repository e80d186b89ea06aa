"""Where orientations come fused from the modules, figures tell of what puts these together."""

from devices.link import Chunk, Framing
from firmware_protocol import FusedSample
from firmware_protocol.framing import encode_frame
from firmware_protocol.packets import wire_frame
from gateway.body.rig import load_rig
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings

FUSED = FusedSample((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)


def test_drops_and_late_samples_are_those_of_the_fused_assembler():
    links = [LinkSettings(name="suit", url="/dev/null")]
    service = Service(GatewaySettings(links=links, rig="arm_3", reconstructor="fused"), load_rig("arm_3"))
    service.pipeline.add_link("suit", Framing.BYTE_STREAM)

    def send(module, sequence, stamp_us, at_ns):
        data = encode_frame(wire_frame(FUSED, module, sequence, stamp_us))
        service.pipeline.feed(Chunk(data, at_ns, "suit"))

    module = service.pipeline.suit.module_ids[0]
    stranger = max(service.pipeline.suit.module_ids) + 1
    send(module, 1, 2_000_000, 2_000_000_000)
    send(module, 2, 1_990_000, 2_001_000_000)  # overtaken on its way
    send(stranger, 1, 2_000_000, 2_002_000_000)
    figures = service.observer.figures()
    assert figures.dropped_by_assembly == {"late": 1, "unknown_module": 1}
    states = {state.module: state.late for state in figures.modules}
    assert states[module] == 1
