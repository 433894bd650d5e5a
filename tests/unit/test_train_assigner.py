"""Training the assigner in small: cases and their labels, the losses worked by hand, a run killed and
resumed, the export, the command.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from procs.assigner.learned import Network, load
from procs.assigner.many import gnn_rings
from tools.cli import app
from tools.train.assigner.data import Batch, instances, mixed_batch, solved
from tools.train.assigner.export import check_export
from tools.train.assigner.model import RingNetwork
from tools.train.assigner.paper import paper_loss
from tools.train.assigner.training import Settings, assignment_loss, batch_tensors, train

TINY = Settings(steps=6, warmup_steps=2, cooldown_steps=2, polish_steps=2, save_every_steps=3)


def test_agents_stand_in_order_of_their_angle() -> None:
    # One goal in the middle and two far apart fix each agent's side: the order must go round.
    costs = instances(np.random.default_rng(0), 50, 6, 40)
    again = instances(np.random.default_rng(0), 50, 6, 40)
    np.testing.assert_array_equal(costs, again)
    neighbours = np.abs(costs - np.roll(costs, 1, axis=1)).mean()
    opposite = np.abs(costs - np.roll(costs, 3, axis=1)).mean()
    assert neighbours < 0.75 * opposite


def test_labels_are_the_optimum_and_none_for_who_goes_without() -> None:
    costs = np.array([[[1.0, 2.0], [1.0, 6.0], [9.0, 9.0]], [[np.inf, 1.0], [np.inf, 2.0], [np.inf, 3.0]]])
    np.testing.assert_array_equal(solved(costs), [[1, 0, 2], [1, 2, 2]])


def test_batches_repeat_by_seed_and_cover_what_the_card_says() -> None:
    batches = [mixed_batch(np.random.default_rng([1, k])) for k in range(150)]
    again = mixed_batch(np.random.default_rng([1, 7]))
    np.testing.assert_array_equal(batches[7].costs, again.costs)
    sizes = [batch.costs.shape[1:] for batch in batches]
    assert {n for n, _ in sizes} >= set(range(1, 9))
    assert any(n > 8 for n, _ in sizes)
    assert any(n > g for n, g in sizes)
    assert any(batch.loss > 0 for batch in batches)
    assert any(np.isinf(batch.costs).any() for batch in batches)
    assert all(batch.rounds == 5 or batch.costs.shape[1] > 8 for batch in batches)


def test_a_label_that_cannot_be_chosen_teaches_nothing() -> None:
    batch = Batch(np.array([[[np.inf, 1.0], [np.inf, 2.0]]]), np.array([[1, 2]]), 0.0)
    *_, labels = batch_tensors(batch, np.random.default_rng(0))
    assert labels.tolist() == [[1, -100]]


def test_our_loss_counts_clashing_pairs() -> None:
    settings = replace(TINY, clash_weight=0.3, round_weights=())
    sure = torch.tensor([[[20.0, 0.0], [0.0, 20.0]]])
    both = torch.tensor([[[20.0, 0.0], [20.0, 0.0]]])
    labels = torch.tensor([[0, 1]])
    assert assignment_loss([sure], labels, 2, settings).item() == pytest.approx(0.0, abs=1e-4)
    # One agent of two is wrong by 20; one clashing pair, per five agents.
    assert assignment_loss([both], labels, 2, settings).item() == pytest.approx(10 + 0.3 * 2.5, abs=1e-3)


def test_the_papers_loss_by_hand() -> None:
    labels = torch.tensor([[0, 1]])
    right = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    assert paper_loss(right, labels, 0.5).item() == pytest.approx(0.0, abs=1e-4)
    same = torch.tensor([[[0.9, 0.1], [0.9, 0.1]]])
    truth = -(0.9 * (np.log(0.9) + np.log(0.1)) + 0.1 * (np.log(0.9) + np.log(0.1))) / 4
    assert paper_loss(same, labels, 0.5).item() == pytest.approx(0.5 * (2**0.5 + 1) + 0.5 * truth, abs=1e-3)


def test_the_papers_validity_has_no_gradient() -> None:
    chances = torch.tensor([[[0.9, 0.1], [0.6, 0.4]]], requires_grad=True)
    labels = torch.tensor([[0, 1]])
    paper_loss(chances, labels, 1.0).backward()  # type: ignore[no-untyped-call]
    whole = chances.grad.clone() if chances.grad is not None else torch.zeros(0)
    directions = chances.detach().clone().requires_grad_(True)
    norms = torch.linalg.norm(directions, dim=-1)
    (directions[:, 0] * directions[:, 1]).sum(-1).div(norms[:, 0] * norms[:, 1]).sum().backward()
    torch.testing.assert_close(whole, directions.grad)


def test_a_killed_run_goes_on_as_if_nothing_had_happened(tmp_path: Path) -> None:
    whole = train(tmp_path / "a", TINY)
    train(tmp_path / "b", TINY, stop_after=3)
    resumed = train(tmp_path / "b", TINY)
    assert whole.read_bytes() == resumed.read_bytes()
    assert whole.stat().st_size <= 500_000
    assert "agree on" in check_export(RingNetwork(), whole)
    with pytest.raises(ValueError, match="other settings"):
        train(tmp_path / "b", replace(TINY, rate=1e-3))


def test_an_export_that_numpy_reads_otherwise_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = train(tmp_path, TINY)
    found = load(weights)
    other = Network(found.weights | {"goal.weight": -found.weights["goal.weight"]})
    monkeypatch.setattr(
        "tools.train.assigner.export.gnn_rings",
        lambda costs, rounds, loss, random, _: gnn_rings(costs, rounds, loss, random, other),
    )
    with pytest.raises(ValueError, match="export anew"):
        check_export(RingNetwork(), weights)


@pytest.mark.parametrize("loss", ["ours", "paper"])
def test_the_command_trains_and_measures(tmp_path: Path, loss: str) -> None:
    found = CliRunner().invoke(app, ["train", "assigner", "--smoke", "--loss", loss, "--out", str(tmp_path)])
    assert found.exit_code == 0, found.output
    assert "distinct" in found.output
    wrong = CliRunner().invoke(app, ["train", "assigner", "--loss", "other", "--out", str(tmp_path)])
    assert wrong.exit_code != 0
