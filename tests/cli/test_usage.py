from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

import dualslam
from dualslam.__main__ import main as command
from dualslam.cli import main
from dualslam.cli.configuration import config_of
from dualslam.cli.parser import parse
from dualslam.core.config.files import load_config


def one_sentence(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("dualslam")
    assert "Traceback" not in lines[0]
    return lines[0]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("", "COMMAND"),
        ("rum", "invalid choice: 'rum'"),
        ("run", "SOURCE, --out"),
        ("run here", "--out"),
        ("run here --out=", "argument --out: is empty"),
        ("run here --out there --fov 200", "between 1 and 180 degrees, not '200'"),
        ("run here --out there --fov 70 --camera c.txt", "not allowed with"),
        ("run here --out there --inline --workers 2", "not allowed with"),
        ("run here --out there --stride 0", "at least 1, not '0'"),
        ("run here --out there --start -1", "at least 0, not '-1'"),
        ("run here --out there --max-frames many", "at least 1, not 'many'"),
        ("run here --out there --seed -3", "at least 0"),
        ("run here --out there --sed 3", "unrecognized arguments: --sed 3"),
        ("run nowhere --out there", "nowhere does not exist"),
        ("run synthetic:sea --out there", "'sea' is unknown"),
        ("run synthetic:street,frames=x --out there", "frames must be a whole number, not 'x'"),
        ("run synthetic:street,frames=0 --out there", "n_frames is 0"),
        ("run synthetic:street,size=3 --out there", "no option 'size'"),
        ("run synthetic:street,width=8 --out there", "width is 8"),
        ("run synthetic:street,events=none.yaml --out there", "none.yaml cannot be read"),
        ("run synthetic:street --out there --fov 70", "camera of its own"),
        ("run synthetic:street --out there --rate 20", "clock of its own"),
        ("run here --out there --rate 0", "between 0.1 and 10000 Hz, not '0'"),
        ("run here --out there --rate 20 --time-unit ms", "not allowed with"),
        ("run synthetic:street,frames=5 --out there --start 9", "start is 9"),
        ("run synthetic:street,frames=5 --out there --frontend sift9", "sift9"),
        ("run synthetic:street --out there --set frontend.n_feature=3", "did you mean frontend.n_features?"),
        ("run synthetic:street --out there --config none.yaml", "none.yaml: the configuration cannot be read"),
        ("config --set seed=x", "seed must be a whole number"),
        ("config --set recovery.retry_keyframes=[5,0]", "retry_keyframes[1] must be greater than or equal to 1, not 0"),
        ("config --set camera.model_sigma_px=.inf", "camera.model_sigma_px must be less than or equal to 100"),
        (
            "config --set calibration.log_focal_sigma=1e-300",
            "log_focal_sigma must be greater than or equal to 0.000001",
        ),
        ("config --seed 18446744073709551616", "seed must be less than or equal to 18446744073709551615"),
        ("config --frontend sift9", "no front end is called 'sift9'"),
        ("config --frontend os:path", "--frontend os:path: frontend.name: 'os:path' is no front end"),
        (
            "config --set frontend.options.octaves=8",
            "--set frontend.options.octaves=8: frontend.options.octaves: there is no such option",
        ),
        (
            'config --set recovery.attempts=[{"frontend":"sift","options":{"ratios":1}}]',
            ": recovery.attempts[0].options.ratios: there is no such option",
        ),
        ("config --set recovery.attempts=[live,sift9]", "recovery.attempts[1].frontend: no front end is called"),
        ("config --frontend sift --set initialiser.matching=gms", "initialiser.matching: gms takes a front end with"),
        ("config --frontend obr", "--frontend obr: frontend.name: no front end is called 'obr', did you mean 'orb'?"),
        ("config --config typo.yaml", "typo.yaml: frontend.name: no front end is called 'obr'"),
        ("config --config typo.yaml --frontend orb --set recovery.attempts=[orbb]", "--set recovery.attempts=[orbb]: "),
        ("config --config two.yaml", "two.yaml: line 2, column 1: a second document begins here"),
        ("config --set corruptions=[{kind:bluur}]", "corruptions[0]"),
        ("run synthetic:street,size=3 --fov 70 --out there", "no option 'size'"),
        ("run here --ouut there", "--ouut is no option, did you mean --out?"),
        ("render street --out there --foo 3", "dualslam render: unrecognized arguments: --foo 3"),
        ("render street --out there --foo 3", "see dualslam render --help"),
        ("run here --out there --sed 3", "--sed is no option, did you mean --seed?"),
        ("rnu here", "invalid choice: 'rnu'"),
        ("rnu here", "did you mean 'run'?"),
        ("export here --to colmp --out there", "did you mean 'colmap'?"),
        ("config --set seed", "write key.path=value"),
        ("run synthetic:street,frames=5 --out there --map nowhere", "nowhere does not exist or is no folder"),
        (
            "run synthetic:street,frames=5 --out there --map .",
            "holds no map: there is no map.json. Give the folder of a run",
        ),
        ("eval nowhere nowhere", "nowhere does not exist"),
        ("view nowhere --save there", "nowhere is not the folder of a finished run"),
        ("render lake --out there", "invalid choice: 'lake'"),
        ("render street --out there --frames 0", "at least 1"),
        ("render street --out there --events none.yaml", "none.yaml cannot be read"),
        ("demo --frames 3", "at least 60"),
        ("demo --no-recovery", "unrecognized arguments: --no-recovery"),
    ],
)
def test_bad_usage_is_one_sentence_and_status_2(
    arguments: str, expected: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    files = {"typo.yaml": "frontend: {name: obr}\n", "two.yaml": "seed: 1\n---\nseed: 2\n"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert main(arguments.split()) == 2
    assert expected in one_sentence(capsys)
    assert {path.name for path in tmp_path.iterdir()} == set(files)


@pytest.mark.parametrize("command", [["run", "", "--out", "there"], ["eval", "run", ""]])
def test_an_empty_source_is_not_the_working_directory(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command) == 2
    assert "is empty; name a folder, a video file or another source" in one_sentence(capsys)


@pytest.mark.parametrize("command", ["", "run ", "eval ", "view ", "render ", "config ", "demo "])
def test_help_is_there_for_every_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command.split(), "--help"]) == 0
    assert "usage: dualslam" in capsys.readouterr().out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"dualslam {dualslam.__version__}\n"


def test_config_prints_what_reads_back(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["config", "--seed", "5", "--frontend", "orb", "--set", "frontend.n_features=700"]) == 0
    file = tmp_path / "c.yaml"
    file.write_text(capsys.readouterr().out)
    config = load_config(file)
    assert (config.seed, config.frontend.n_features) == (5, 700)
    assert main(["config", "--config", str(file), "--seed", "6", "--no-recovery"]) == 0
    assert "seed: 6" in capsys.readouterr().out


def test_a_configuration_may_come_by_a_pipe(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_text("seed: 7\n"), daemon=True)
    writer.start()
    assert main(["config", "--config", str(tmp_path / "pipe")]) == 0
    assert "seed: 7" in capsys.readouterr().out


def test_an_unexpected_exception_is_a_sentence_and_a_log(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*args: object, **kwargs: object) -> None:
        raise KeyError("x\ny")

    monkeypatch.setattr("dualslam.cli.config_command.config_of", broken)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["config"]) == 1
    sentence = one_sentence(capsys)
    assert "bug" in sentence
    assert "KeyError" in sentence
    (log,) = tmp_path.glob("dualslam-bug-*.log")
    assert str(log) in sentence
    assert "Traceback" in log.read_text()


def test_an_interrupt_while_a_command_is_loaded(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(name: str) -> object:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error  # as pybind does
        return SimpleNamespace(execute=lambda args: 0, check=lambda args: None)

    monkeypatch.setattr("dualslam.cli.parser.import_module", load)
    assert main(["config"]) == 130
    assert one_sentence(capsys) == "dualslam: interrupted"


def test_an_interrupt_before_the_command_is_one_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("dualslam.cli.main", interrupted)
    assert command() == 130
    assert one_sentence(capsys) == "dualslam: interrupted"


def test_a_keyboard_interrupt_outside_of_a_run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dualslam.cli.config_command.config_of", interrupted)
    assert main(["config"]) == 130
    assert one_sentence(capsys) == "dualslam: interrupted"


def test_warnings_wait_until_the_input_has_proved_good(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, folder: Path, fake: object
) -> None:
    (tmp_path / "images").mkdir()
    images = sorted((folder / "images").iterdir())
    for image in images:
        (tmp_path / "images" / image.name).symlink_to(images[0])  # where nothing moves, nothing tells the camera
    command = ["run", str(tmp_path / "images"), "--out", str(tmp_path / "run")]
    assert main(command) == 2
    assert "no calibration" in one_sentence(capsys)
    assert main([*command, "--fov", "70"]) == 0
    assert "WARNING" in capsys.readouterr().err


HEAVY = ("torch", "kornia", "matplotlib", "rerun", "cv2", "gtsam", "numpy", "scipy", "pydantic", "yaml")


@pytest.mark.parametrize("statement", ["import dualslam", "import dualslam.cli", "from dualslam import limit_threads"])
def test_importing_is_light(statement: str) -> None:
    code = f"import sys; {statement}; print(*(set(sys.modules) & set({HEAVY})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_every_public_name_is_there() -> None:
    for name in dualslam.__all__:
        assert getattr(dualslam, name) is not None
        assert name in dir(dualslam)
    with pytest.raises(AttributeError, match="nonsense"):
        dualslam.nonsense  # noqa: B018


def test_importing_everything_public_leaves_extras_alone() -> None:
    code = "import sys, dualslam; [getattr(dualslam, n) for n in dualslam.__all__]; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "kornia", "matplotlib", "pandas", "rerun"} & set(done.stdout.split())


def test_a_run_on_a_recording_loads_neither_renderer_nor_optimiser() -> None:
    code = "import sys, dualslam.build, dualslam.run.session; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"dualslam.lab.synthetic", "scipy.optimize"} & set(done.stdout.split())


def test_limit_threads_leaves_what_the_user_has_set() -> None:
    code = (
        "import os; from dualslam import limit_threads; early = limit_threads(); import numpy;"
        "print(early, limit_threads(), os.environ['OMP_NUM_THREADS'], os.environ['OPENBLAS_NUM_THREADS'])"
    )
    environment = {"OMP_NUM_THREADS": "3", "PATH": ""}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == ["True", "False", "3", "1"]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no such setting")
def test_freed_memory_is_kept() -> None:
    code = (
        "import resource; from dualslam import keep_freed_memory; kept = keep_freed_memory();"
        "fill = lambda: [b'x' * 2**23 for _ in range(12)]; fill();"
        "faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt;"
        "before = faults(); fill(); print(kept, faults() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    kept, n_faults = done.stdout.split()
    assert kept == "True"
    assert int(n_faults) < 2000  # of 24000 pages


@pytest.mark.parametrize(
    ("options", "workers"),
    [
        ("", 0),
        ("--realtime", 1),
        ("--realtime --inline", 0),
        ("--realtime --set recovery.workers=3", 3),
        ("--workers 2 --set recovery.workers=3", 2),
    ],
)
def test_where_recovery_runs(options: str, workers: int) -> None:
    args = parse(["run", "here", "--out", "there", *options.split()])
    assert config_of(args).recovery.workers == workers


@pytest.mark.parametrize("form", ["ply", "tum", "colmap"])
def test_an_export_to_where_no_folder_can_be(form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "deeper" / "map"
    assert main(["export", str(tmp_path), "--to", form, "--out", str(out)]) == 2
    assert f"{out} cannot be written: Not a directory; name another with --out." in one_sentence(capsys)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("run nowhere.mp4 --out there", "nowhere.mp4 does not exist"),
        ("run synthetic:street --out there --set sed=3", "did you mean seed?"),
        ("run synthetic:street --out there --config none.yaml", "none.yaml"),
        ("run synthetic:street --out there --replay nowhere", "nowhere/schedule.jsonl"),
        ("demo --set sed=3", "did you mean seed?"),
    ],
)
def test_mistyped_paths_and_fields_are_answered_before_anything_heavy_is_loaded(arguments: str, expected: str) -> None:
    code = f"import sys; from dualslam.cli import main; print(main({arguments.split()!r}), *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    status, *loaded = done.stdout.split()
    assert status == "2"
    assert expected in done.stderr
    assert not {"cv2", "gtsam", "scipy", "faiss"} & set(loaded)
