"""A training goes on from its own checkpoint and says what it does not heed; no other file passes for one."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from typer.testing import CliRunner

from tools.cli import app
from tools.errors import UNUSABLE, UnusableError
from tools.train.detector import training
from tools.train.detector.pictures import Mixture
from tools.train.detector.run import Given, Run, Settings
from tools.train.detector.training import LOG_COLUMNS, train

torch.set_num_threads(1)  # on a busy machine two wait for each other
PICTURES = Mixture(batch=2, side=64, scenes=2)
TINY = Settings(PICTURES, steps=4, early_side=64, warmup_steps=1, save_every_steps=2, workers=0)
OWN = Given(Path("my/data.yaml"), ("whale", "calf"), Path("start.onnx"))


@pytest.fixture(autouse=True)
def _no_real_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests must pass without the real data."""
    monkeypatch.setenv("PODWATCH_REAL_DATA", "/nowhere")


def left(folder: Path, step: int, given: Given) -> Path:
    """The checkpoint of a run of TINY that stands at a step."""
    run, path = Run(TINY), folder / "checkpoint.pt"
    run.step = step
    run.save(path, TINY, given)
    return path


def resumed(path: Path, given: Given, settings: Settings = TINY) -> None:
    Run(settings).load(path, settings, given)


def without(path: Path, *names: str) -> Path:
    """The checkpoint as an older trainer wrote it."""
    state = torch.load(path, weights_only=True)
    torch.save({name: value for name, value in state.items() if name not in names}, path)
    return path


def test_a_checkpoint_that_cannot_be_read_is_refused_by_name(tmp_path: Path) -> None:
    path = left(tmp_path, 2, Given())
    whole = path.read_bytes()
    for content in (b"", b"nothing", whole[: len(whole) // 2]):
        path.write_bytes(content)
        result = CliRunner().invoke(app, ["train", "detector", "--out", str(tmp_path)])
        assert result.exit_code == UNUSABLE
        assert f"{path}: no checkpoint of this trainer, or cut off; choose another --out" in result.stderr
        assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"model": 1}, r"of an older or of another trainer, without network, .*--from .*checkpoint\.pt"),
        ([1, 2], "of an older or of another trainer"),
    ],
)
def test_a_file_of_another_trainer_is_refused(tmp_path: Path, content: object, message: str) -> None:
    torch.save(content, tmp_path / "checkpoint.pt")
    with pytest.raises(UnusableError, match=rf"checkpoint\.pt: {message}"):
        resumed(tmp_path / "checkpoint.pt", Given())


def test_a_checkpoint_of_another_network_or_width_is_refused(tmp_path: Path) -> None:
    path = left(tmp_path, 2, Given())
    with pytest.raises(UnusableError, match=r"of width 1\.0, not 0\.5; choose another --out"):
        resumed(path, Given(), replace(TINY, width=0.5))
    state = torch.load(path, weights_only=True)
    for name in ("network", "average", "optimiser"):
        torch.save(state | {name: {"foreign": torch.zeros(3)}}, path)
        with pytest.raises(UnusableError, match=r"checkpoint\.pt: of another network than this one; choose"):
            resumed(path, Given())
    torch.save(state, path)
    with pytest.raises(UnusableError, match="without width; choose another --out"):
        resumed(without(path, "width"), Given())


@pytest.mark.parametrize(
    ("now", "message"),
    [
        (Given(), "with --data my/data.yaml, not without --data"),
        (replace(OWN, data=Path("other.yaml")), "with --data my/data.yaml, not with --data other.yaml"),
        (replace(OWN, classes=("whale",)), "with --classes calf, whale, not with --classes whale"),
        (replace(OWN, begin_from=Path("b.onnx")), r"with --from start\.onnx, not with --from b\.onnx"),
    ],
)
def test_what_a_run_would_leave_unheeded_is_refused(tmp_path: Path, now: Given, message: str) -> None:
    with pytest.raises(UnusableError, match=f"was trained {message}; to go on give the same again; else"):
        resumed(left(tmp_path, 2, OWN), now)
    with pytest.raises(UnusableError, match=f"{message}; it is trained to the end; .*--from .*checkpoint.pt"):
        resumed(left(tmp_path, 4, OWN), now)


def test_weights_that_are_given_to_a_run_that_began_without_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnusableError, match=r"trained without --from, not with --from start\.onnx"):
        resumed(left(tmp_path, 2, Given()), Given(begin_from=Path("start.onnx")))


def test_the_same_command_goes_on_without_a_word(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = left(tmp_path, 2, OWN)
    resumed(path, OWN)
    resumed(path, replace(OWN, data=OWN.data and OWN.data.absolute(), classes=("calf", "whale")))
    resumed(path, OWN, replace(TINY, workers=3))
    assert capsys.readouterr().out == ""
    resumed(path, replace(OWN, begin_from=None))
    assert capsys.readouterr().out == f"{path}: began from start.onnx\n"
    resumed(path, OWN, replace(TINY, pictures=replace(PICTURES, seed=7)))
    assert "pictures was" in capsys.readouterr().out


def test_an_older_checkpoint_which_does_not_say_what_was_given_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = without(left(tmp_path, 2, OWN), "given")
    resumed(path, Given(Path("any.yaml")))
    assert capsys.readouterr().out == ""
    resumed(path, OWN)
    assert capsys.readouterr().out == f"{path}: goes on from here; --from start.onnx is not read again\n"


def test_the_same_command_after_the_end_exports_again_and_other_settings_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(training, "Batches", lambda *_: pytest.fail("nothing is left to train"))
    path = left(tmp_path, 4, Given())
    first = train(tmp_path, TINY).read_bytes()
    told = capsys.readouterr().out
    assert told.startswith("already trained to the end, 4 steps: it is exported again")
    assert f"choose another --out, and --from {path}" in told
    assert train(tmp_path, replace(TINY, steps=3, workers=2)).read_bytes() == first
    with pytest.raises(
        UnusableError, match=r"pictures was .*changes nothing: it is trained to the end; choose"
    ):
        train(tmp_path, replace(TINY, pictures=replace(PICTURES, seed=7)))


def test_the_log_of_a_killed_run_ends_at_its_checkpoint_and_names_its_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "_step", stopped)
    monkeypatch.setattr(training, "_from", lambda *_: iter([(None, None)]))
    monkeypatch.setattr(
        training, "Batches", lambda *_: SimpleNamespace(rendered=[], empty=[], photographs=[])
    )
    settings, log = replace(TINY, steps=200), tmp_path / "log.csv"
    rows = [f"{step},2.5,1.25,0.001,{second},0.5" for second, step in enumerate((50, 100, 100, 150))]
    log.write_text("\n".join([*rows, "200,1.9"]))  # killed while it wrote a row, and once before that
    for step, kept in ((100, [rows[0], rows[2]]), (100, [rows[0], rows[2]]), (0, [])):
        left(tmp_path, step, Given())
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path, settings)
        assert log.read_text().splitlines() == [LOG_COLUMNS, *kept]


def test_a_loss_that_is_no_number_is_told_with_a_remedy_that_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none, number, batch = (
        torch.tensor(torch.nan),
        torch.tensor(1.0),
        torch.zeros(2, 64, 64, 3, dtype=torch.uint8),
    )
    monkeypatch.setattr(training, "detection_loss", lambda *_: (none, number))
    monkeypatch.setattr(training, "_from", lambda *_: iter([(batch, [torch.zeros(0, 5)] * 2)]))
    monkeypatch.setattr(
        training, "Batches", lambda *_: SimpleNamespace(rendered=[], empty=[], photographs=[])
    )
    left(tmp_path, 2, Given())
    with pytest.raises(UnusableError, match=r"the loss is nan at step 2.*another --seed, which goes on"):
        train(tmp_path, TINY)
    monkeypatch.setattr(training, "detection_loss", lambda *_: (number.clone().requires_grad_(), number))
    train(tmp_path, replace(TINY, pictures=replace(PICTURES, seed=1)), stop_after=3)
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["step"] == 3
