from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from dualslam.core.config import strict_yaml
from dualslam.core.config.files import Override, config_from_dict, dump_config, load_config, load_run_config
from dualslam.core.config.settings import Config, Corruption, GraphConfig
from dualslam.core.errors import ConfigError


def error_of(*overrides: str, path: Path | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_without_file_and_overrides_it_is_the_default() -> None:
    assert load_config() == Config()


def test_dump_reads_back_as_the_same_config(tmp_path: Path) -> None:
    config = load_config(None, ["seed=7", "graph.robust_k=1.0000000000000002", "frontend.options.a.b=[1, no, null]"])
    file = tmp_path / "config.yaml"
    file.write_text(dump_config(config))
    assert load_config(file) == config
    assert config.graph.robust_k == 1.0000000000000002
    assert config.frontend.options == {"a": {"b": [1, "no", None]}}


def test_dump_explains_every_field() -> None:
    lines = dump_config(Config()).splitlines()
    for name in ("seed", "frontend", "graph"):
        at = next(i for i, line in enumerate(lines) if line.startswith(f"{name}:"))
        assert lines[at - 1].startswith("# ")
    assert all(len(line) <= 120 for line in lines)
    at = lines.index(f"  n_features: {Config().frontend.n_features}")
    assert lines[at - 1] == "  # Keypoints per image."


def test_dump_is_ordinary_yaml_for_other_readers() -> None:
    assert yaml.safe_load(dump_config(Config())) == Config().model_dump(mode="json")


def test_last_override_wins_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("seed: 3\nfrontend: {n_features: 800}\n")
    assert load_config(file).frontend.n_features == 800
    config = load_config(file, ["frontend.n_features=900", "frontend.n_features=1000"])
    assert config.frontend.n_features == 1000
    assert config.seed == 3
    assert config.frontend.name == "auto"


def test_an_empty_file_is_the_default(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("# nothing here\n")
    assert load_config(file) == Config()


def test_unknown_field_names_the_nearest() -> None:
    message = error_of("frontend.n_feature=3")
    assert message.startswith(
        "--set frontend.n_feature=3: unknown field frontend.n_feature; did you mean frontend.n_features?"
    )
    assert "name, n_features, options" in message
    assert "did you mean frontend.n_features?" in error_of("n_features=3")
    assert "did you mean graph?" in error_of("grpah.robust_k=1")
    assert "did you mean" not in error_of("xyzzy=2")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("seed=-1", "seed must be greater than or equal to 0, not -1"),
        ("seed='3'", 'seed must be a whole number, not "3"'),
        ("seed=1.5", "seed must be a whole number, not 1.5"),
        ("seed=", "seed must be a whole number, not null"),
        ("seed=true", "seed must be a whole number, not true"),
        ("frontend.name=true", "frontend.name must be a word, not true"),
        ("frontend=3", "frontend must be a mapping of fields, not 3"),
        ("graph.max_keyframes=5000", "graph.max_keyframes must be less than or equal to 1000, not 5000"),
        ("graph.robust_k=.nan", "graph.robust_k must be greater than 0, not NaN"),
        ("seed", "write key.path=value"),
        ("=3", "write key.path=value"),
        ("frontend.=3", "write key.path=value"),
        ("recovery.attempts=[]", "recovery.attempts must have at least 1 item, not 0"),
        ("seed=[1", "the value is not valid YAML"),
    ],
)
def test_wrong_values_are_named(override: str, expected: str) -> None:
    message = error_of(override)
    assert message.startswith(f"--set {override}: ")
    assert expected in message


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"c.yaml: the configuration is not a text file in UTF-8$"):
        load_config(tmp_path / "c.yaml")


def test_an_error_in_the_file_names_the_file_not_the_override(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("graph: {robust_k: -1}\n")
    assert error_of("seed=3", path=file).startswith(f"{file}: graph.robust_k must be greater than 0")


def test_all_errors_are_counted() -> None:
    assert error_of("seed=-1", "graph.robust_k=-1").endswith("(and 1 more)")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("seed: [1\n", "line 2, column 1: "),
        ("- 1\n", "this is a list"),
        ("seed: 1\nseed: 2\n", "line 2, column 1: the key 'seed' stands there twice"),
        ("1: 2\n", "the key 1 is not a word"),
        ("seed: &a 1\ngraph: *a\n", "aliases"),
        ("a\tb: \x00", "not valid YAML"),
    ],
)
def test_broken_files_are_one_sentence(tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(text)
    message = error_of(path=file)
    assert message.startswith(f"{file}: ")
    assert expected in message


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "No such file" in error_of(path=tmp_path / "none.yaml")
    assert "directory" in error_of(path=tmp_path)
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x81")
    assert "binary" in error_of(path=tmp_path / "binary")


def test_setting_below_a_plain_value_of_the_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("frontend: orb\n")
    assert "frontend is not a section" in error_of("frontend.name=orb", path=file)


def test_config_from_dict_is_as_strict() -> None:
    assert config_from_dict({"frontend": {"name": "sift"}}).frontend.name == "sift"
    with pytest.raises(ConfigError, match="seed must be a whole number"):
        config_from_dict({"seed": "1"})
    with pytest.raises(ConfigError, match="YAML cannot"):
        config_from_dict({"frontend": {"options": {"a": object()}}})


def test_override_with_a_source_of_its_own() -> None:
    with pytest.raises(ConfigError, match=r"^--frontend 3: "):
        load_config(None, [Override(("frontend", "name"), 3, "--frontend 3")])


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001), ("1E5", 1e5), (".5", 0.5), ("5.", 5.0), ("-2", -2), ("0x10", 16), ("010", 10),
        ("no", "no"), ("on", "on"), ("true", True), ("null", None), ("~", None), ("1:30", "1:30"),
        ("2001-01-01", "2001-01-01"), ("1_000", "1_000"), ("=", "="), (".inf", float("inf")), ("", None),
    ],
)  # fmt: skip
def test_scalars_follow_yaml_1_2(text: str, value: object) -> None:
    read = strict_yaml.loads(text)
    assert read == value
    assert type(read) is type(value)


plain = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(st.characters(codec="utf-8"))
nested = st.recursive(
    plain, lambda inner: st.lists(inner) | st.dictionaries(st.text(st.characters(codec="utf-8")), inner), max_leaves=20
)


@settings(max_examples=50)
@given(nested)
def test_what_is_written_reads_back(value: object) -> None:
    assert strict_yaml.loads(strict_yaml.dumps(value)) == value


@pytest.mark.parametrize("setting", ["health.majority=0.4", "recovery.max_leap_frames=5", "nothing.at_all=1"])
def test_a_field_that_does_not_exist_is_one_sentence(setting: str) -> None:
    with pytest.raises(ConfigError, match=rf"unknown field {re.escape(setting.split('=')[0].split('.')[0])}") as caught:
        load_config(overrides=[setting])
    assert "\n" not in str(caught.value)


# --- made in Python


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: GraphConfig(max_keyframes=-1),
            "GraphConfig: max_keyframes must be greater than or equal to 20, not -1",
        ),
        (lambda: GraphConfig(max_keyframe=99), "GraphConfig: unknown field max_keyframe; did you mean max_keyframes?"),
        (lambda: Config(graph={"max_keyframes": -1}), "Config: graph.max_keyframes must be greater than"),
        (lambda: Config(seed=np.zeros(3)), "Config: seed must be a whole number, not a ndarray"),
        (lambda: Corruption(kind="blur", strength=900), "Corruption: strength of blur is 900"),
        (lambda: Config().model_copy(update={"recovry": False}), "unknown field recovry; did you mean recovery?"),
        (lambda: setattr(Config(), "seed", 1), "Config.seed cannot be changed, a configuration is frozen"),
        (lambda: load_config({"seed": 1}), "of a dict, config_from_dict makes a configuration"),
        (lambda: load_config(overrides="seed=1"), "overrides is a list of texts"),
        (lambda: config_from_dict([1]), "config: a configuration is a mapping of fields to values, this is a list"),
    ],
)
def test_what_python_gives_is_refused_in_one_sentence(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_sections_made_in_python_are_as_those_of_a_file() -> None:
    config = Config(recovery={"enabled": False, "attempts": ("live", "gap")}, graph=GraphConfig(max_keyframes=50))
    same = load_config(overrides=["recovery.enabled=false", "recovery.attempts=[live, gap]", "graph.max_keyframes=50"])
    assert config == same
    assert pickle.loads(pickle.dumps(config)) == same
    assert Config().model_copy(update={"recovery": {"enabled": False}}).recovery.enabled is False
    with pytest.raises(ConfigError, match="seed must be a whole number"):
        config_from_dict({"seed": "5"})  # in Python, too, a file's strictness for what could stand in a file


def test_fields_of_an_earlier_version_are_left_out_of_a_run_folder_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("seed: 7\nold_section: {a: 1}\ngraph: {robust_k: 2.0, old_knob: 3}\n")
    config = load_run_config(tmp_path, ["graph.robust_k=1.5"])
    assert (config.seed, config.graph.robust_k) == (7, 1.5)
    (warning,) = caplog.messages
    assert "old_section" in warning
    assert "graph.old_knob" in warning
    assert "unknown field" in error_of(path=file)
    with pytest.raises(ConfigError, match=r"unknown field graph\.old_knob"):  # a person's own, not the file's
        load_run_config(tmp_path, ["graph.old_knob=1"])
    file.write_text("seed: word\nold_section: 1\n")
    with pytest.raises(ConfigError, match="seed must be a whole number"):
        load_run_config(tmp_path)
