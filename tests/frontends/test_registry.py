"""Finding a front end by its name, and refusing names and options that do not exist."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any

import pytest

from dualslam.core.config.settings import FrontendConfig
from dualslam.core.errors import ConfigError
from dualslam.frontends import registry
from dualslam.frontends.features.orb import OrbFrontend


def test_orb_is_built_in_and_takes_its_options() -> None:
    config = FrontendConfig(name="orb", n_features=123, options={"n_octaves": 4, "fast_thresholds": [30, 10]})
    frontend = registry.create_frontend(config)
    assert isinstance(frontend, OrbFrontend)
    assert frontend.n_features == 123
    assert frontend.n_octaves == 4
    assert frontend.options.fast_thresholds == (30, 10)


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'orbb'.*known:.*orb"):
        registry.create_frontend(FrontendConfig(name="orbb"))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"octaves": 8}, r"frontend\.options\.octaves.*n_octaves"),
        ({"n_octaves": "8"}, r"frontend\.options\.n_octaves: .*integer"),
        ({"scale_factor": object()}, r"frontend\.options: .*what YAML cannot hold"),
        ({"scale_factor": 0.5}, r"frontend\.options\.scale_factor"),
        ({"fast_thresholds": []}, r"frontend\.options\.fast_thresholds"),
        ({"fast_thresholds": [20, 0]}, r"frontend\.options\.fast_thresholds\[1\]"),
    ],
)
def test_wrong_option_is_named(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        registry.create_frontend(FrontendConfig(options=options))


def offer(monkeypatch: pytest.MonkeyPatch, **entries: str) -> None:
    """Pretend that installed packages offer these front ends."""
    offered = EntryPoints(EntryPoint(name, value, registry.ENTRY_POINT_GROUP) for name, value in entries.items())
    monkeypatch.setattr(registry, "entry_points", lambda **wanted: offered.select(**wanted))


def test_entry_points_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    offer(monkeypatch, theirs="dualslam.frontends.features.orb:OrbFrontend", orb="nowhere:Nothing")
    assert registry.FRONTENDS.known == sorted([*registry.BUILT_IN, "theirs"])
    assert isinstance(registry.create_frontend(FrontendConfig(name="theirs")), OrbFrontend)
    assert isinstance(registry.create_frontend(FrontendConfig(name="orb")), OrbFrontend)


def test_what_can_be_imported_needs_no_entry_point() -> None:
    assert isinstance(
        registry.create_frontend(FrontendConfig(name="dualslam.frontends.features.orb:OrbFrontend")), OrbFrontend
    )
    with pytest.raises(ConfigError, match=r"'dualslam\.frontends\.features\.orb:Nothing'.*cannot be imported"):
        registry.create_frontend(FrontendConfig(name="dualslam.frontends.features.orb:Nothing"))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("os:path", "^frontend.name: 'os:path' is no front end: it has no from_options$"),
        ("numpy:ndarray", "is no front end: it has no from_options"),
        ("nomod:X", "^frontend.name: 'nomod:X' cannot be imported: No module named 'nomod'$"),
        (":", "':' is not of the form module:Class"),
        ("os:", "'os:' is not of the form module:Class"),
        (":path", "':path' is not of the form module:Class"),
        ("..os:path", "is not of the form module:Class"),
    ],
)
def test_what_is_no_front_end_is_a_config_error(name: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        registry.create_frontend(FrontendConfig(name=name))
    with pytest.raises(ConfigError, match=said):
        registry.check_frontend(FrontendConfig(name=name))


class Half:
    """What poses the frames of reverse tracking, and no more."""

    extract = match_wide = None

    @classmethod
    def from_options(cls, n_features: int, options: dict[str, Any]) -> Half:
        return cls()


def test_what_a_front_end_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_import", lambda name, kind: Half)
    said = (
        "^frontend.name: 'half:Half' is no front end: it has no distance, scale_factor, n_octaves, max_distance, "
        "max_distance_strict$"
    )
    with pytest.raises(ConfigError, match=said):
        registry.create_frontend(FrontendConfig(name="half:Half"))
    assert isinstance(registry.create_frontend(FrontendConfig(name="half:Half"), registry.FOR_WALKS), Half)


def test_a_front_end_is_checked_without_its_extra() -> None:
    code = """
import sys
sys.modules["torch"] = sys.modules["kornia"] = None
from dualslam.cli import main
sys.exit(main(["config", "--frontend", "kornia"]))
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "name: kornia" in done.stdout
    with pytest.raises(ConfigError, match=r"frontend\.options\.no_such: there is no such option"):
        registry.check_frontend(FrontendConfig(name="kornia", options={"no_such": 1}))


@pytest.mark.parametrize("value", ["no_such_module:Thing", "dualslam.frontends.features.orb:NoSuchThing"])
def test_broken_entry_point_is_a_config_error(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    offer(monkeypatch, broken=value)
    with pytest.raises(ConfigError, match=r"'broken'.*cannot be imported"):
        registry.create_frontend(FrontendConfig(name="broken"))


def test_registry_imports_no_front_end_by_itself() -> None:
    orb = "dualslam.frontends.features.orb"
    code = f"import sys, dualslam.frontends.registry; sys.exit('cv2' in sys.modules or {orb!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
