"""What a link carries decides what may be said of it; what is wrong is told with its place and a remedy."""

import pytest

from gateway.body.rig import load_rig
from gateway.errors import SettingsError
from gateway.settings import GatewaySettings, fitting_suit, load_gateway_settings
from gateway.sources.link_settings import GnssLinkSettings


def settings_of(tmp_path, *links):
    path = tmp_path / "gateway.yaml"
    told = "".join(f"  - {{name: l{k}, {link}}}\n" for k, link in enumerate(links))
    path.write_text(f"rig: single\nreconstructor: independent\nlinks:\n{told}")
    return load_gateway_settings(path)


def test_a_receiver_has_settings_of_its_own(tmp_path):
    settings = settings_of(tmp_path, "url: 'tcp://a:1'", "url: 'tcp://a:2', carries: gnss, latency_ms: 80")
    modules, receiver = settings.links
    assert isinstance(receiver, GnssLinkSettings)
    assert (receiver.device, receiver.latency_ms, receiver.origin) == (60, 80, None)
    assert not isinstance(modules, GnssLinkSettings)
    again = GatewaySettings.model_validate(settings.model_dump(mode="json"))
    assert again.links == settings.links


@pytest.mark.parametrize(
    ("link", "told"),
    [
        (
            "url: 'tcp://a:1', carries: gnsss",
            r"'links.0' .* no source reads 'gnsss' \(did you mean 'gnss'",
        ),
        (
            "url: 'tcp://a:1', carries: witmoton, module: 3",
            r"no source reads 'witmoton' \(did you mean 'witmotion'\?\)",
        ),
        ("url: 'tcp://a:1', colour: 3", r"unknown setting 'links.0.colour' \(known: carries, name, url\)"),
        ("url: 'tcp://a:1', device: 3", r"'device' goes with carries: gnss; this link carries suit"),
        (
            "url: 'tcp://a:1', module: 3",
            r"'module' goes with carries: ximu3, mti, .*; this link carries suit",
        ),
        (
            "url: 'tcp://a:1', carries: witmotion, module: 3, identifier: 80",
            r"'identifier' goes with carries: witmotion_can; this link carries witmotion",
        ),
        ("url: 'tcp://me:word@a:1', module: 3", "a link takes no user name or password"),
        ("url: 'tcp://a:1', carries: gnss, orgin: [1, 2, 3]", r"'links.0.orgin' \(did you mean 'origin'\?\)"),
        ("url: 'tcp://a:1', carries: gnss, device: 64", r"'links.0.device' is 64"),
        ("url: 'tcp://a:1', carries: gnss, origin: [91, 0, 0]", "latitude within ±90"),
        ("url: 'markers:///a.c3d', carries: gnss", "markers:// carries markers and nothing else"),
    ],
)
def test_what_a_link_cannot_have_is_told_with_its_place(tmp_path, link, told):
    with pytest.raises(SettingsError, match=told):
        settings_of(tmp_path, link)


@pytest.mark.parametrize(("carries", "lacks"), [("markers", "no markers"), ("heat_maps", "no cameras")])
def test_what_the_suit_has_no_use_for_is_refused_before_anything_is_opened(tmp_path, carries, lacks):
    settings = settings_of(tmp_path, f"url: 'udp://:7001', carries: {carries}")
    with pytest.raises(
        SettingsError, match=f"link 'l0' carries {carries.replace('_', ' ')}: the rig has {lacks}"
    ):
        fitting_suit(settings, load_rig("single"))


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ("carries: witmotion, module: 3", "carries: ximu3, module: 3", "'a' and 'b' both have module 3"),
        (
            "carries: mti, module: 5",
            "carries: slimevr, trackers: {10.0.0.7: 5}",
            "'a' and 'b' both have module 5",
        ),
    ],
)
def test_two_devices_of_one_number_are_refused(tmp_path, first, second, told):
    links = f"{{name: a, url: 'udp://:1', {first}}}, {{name: b, url: 'udp://:2', {second}}}"
    path = tmp_path / "gateway.yaml"
    path.write_text(f"rig: arm_3\nlinks: [{links}]\n")
    with pytest.raises(SettingsError, match=f"{told}: every device needs a number of its own"):
        load_gateway_settings(path)
