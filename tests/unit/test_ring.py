"""The ring: one id for one animal in every view, whatever the links do, and consensus only where it is
earned."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from procs.registrar._verdict import is_doubted
from procs.registrar.box_icp import BoxAlignment, align_marks
from procs.registrar.map import HEADER_BYTES, MAX_ANIMALS, MapAnimal, Memory
from procs.registrar.ring import RingNode, ViewGeometry, register_ring
from tools.bench.registration import CAMERA, IMAGE_SIZE, Cell, draw_views, is_ring_right

EPISODE, PROPOSER = 4, 2


def views_of(n_animals, n_views, seed, **changes):
    return draw_views(Cell("", n_animals, n_views=n_views, **changes), np.random.default_rng(seed))


def geometry_of(view, rng):
    """What a drone with GPS noise of 1.5 m and a compass off by 5 degrees believes."""
    pose = view.pose
    return ViewGeometry(
        height_m=pose.height_m * np.exp(rng.normal(0, 0.02)),
        yaw_rad=pose.yaw_rad + rng.normal(0, np.deg2rad(5.0)),
        n_m=pose.n_m + rng.normal(0, 1.5),
        e_m=pose.e_m + rng.normal(0, 1.5),
        focal_px=CAMERA.focal_px,
        roll_rad=pose.roll_rad,
        pitch_rad=pose.pitch_rad,
    )


def nodes_of(views, members=None, **changes):
    members = members or list(range(1, len(views) + 1))
    return [
        RingNode(view.boxes, number, members, EPISODE, PROPOSER, image_size=IMAGE_SIZE, **changes)
        for number, view in zip(members, views, strict=True)
    ]


def fly(nodes, links, rounds=200, deliver=lambda packets: packets):
    """Step all nodes until all have finished; `links` are pairs of rows that hear each other. Returns the
    rounds taken."""
    inboxes = [[] for _ in nodes]
    for done in range(1, rounds + 1):
        said = [node.step(inbox, 0.2 * done) for node, inbox in zip(nodes, inboxes, strict=True)]
        if all(node.finished for node in nodes):
            return done
        inboxes = [[] for _ in nodes]
        for one, other in links:
            inboxes[one] += deliver(said[other])
            inboxes[other] += deliver(said[one])
    raise AssertionError(f"not finished after {rounds} rounds")


def ring_links(count):
    return [(row, (row + 1) % count) for row in range(count)]


class Answers:
    """Node results in the shape that `is_ring_right` reads."""

    def __init__(self, nodes):
        self.identities = [node.result.identities for node in nodes]


def identity(source, target, *, prior=None):
    """The ablation: registration that claims every view to be the same."""
    count = min(len(source), len(target))
    rows = np.arange(count)
    return BoxAlignment(
        np.eye(3),
        np.column_stack([rows, rows]),
        np.arange(count, len(source)),
        np.arange(count, len(target)),
        *(0.0, 1.0, False, 1),
    )


@pytest.mark.parametrize(("n_animals", "n_views"), [(3, 3), (5, 3), (6, 5)])
def test_every_view_names_every_animal_alike(n_animals, n_views):
    views = views_of(n_animals, n_views, seed=n_views)
    answer = register_ring([view.boxes for view in views], image_size=IMAGE_SIZE)
    assert is_ring_right(views, answer)
    assert answer.consensus
    assert answer.laps == 2
    assert not answer.repaired
    assert (answer.bytes_sent > 0).all()


def test_identity_in_place_of_registration_is_no_consensus():
    views = views_of(5, 3, seed=1)
    answer = register_ring([view.boxes for view in views], image_size=IMAGE_SIZE, register=identity)
    assert not answer.consensus


def test_one_wrong_edge_is_no_consensus():
    views = views_of(5, 4, seed=2)
    calls = []

    def planted(source, target, *, prior=None):
        """The third view's matches shifted by one, said with full confidence."""
        found = align_marks(source, target, prior=prior)
        calls.append(len(source))
        if np.allclose(source.centres, planted.centres):
            found.matches[:, 1] = np.roll(found.matches[:, 1], 1)
        return found

    nodes = nodes_of(views, register=planted)
    planted.centres = nodes[2]._observer.marks.centres
    fly(nodes, ring_links(4))
    assert calls
    assert not any(node.result.consensus for node in nodes)


def test_a_lap_that_never_comes_back_to_the_first_views_own_ids_is_no_consensus():
    """Every edge sure of itself, every animal confirmed by every view, and the ring open all the same."""
    boxes = np.array([[100.0, 200, 180, 230], [400, 200, 480, 230]])
    half_turn = np.diag([-1.0, -1.0, 1.0])
    turns = []

    def restless(source, target, *, prior=None):
        """Two animals alike look the same the other way round: the first view changes its mind each lap."""
        if restless.first is not None and source is restless.first:
            turns.append(1)
        swaps = len(turns) % 2 == 1 and source is restless.first
        rows = np.arange(2)
        about = np.eye(3)
        about[:2, 2] = target.centres.mean(axis=0)
        back = np.eye(3)
        back[:2, 2] = -source.centres.mean(axis=0)
        transform = about @ (half_turn if swaps else np.eye(3)) @ back
        columns = rows[::-1] if swaps else rows
        nobody = np.zeros(0, dtype=int)
        return BoxAlignment(transform, np.column_stack([rows, columns]), nobody, nobody, 0.0, 0.99, False, 1)

    restless.first = None
    nodes = [RingNode(boxes, one, [1, 2, 3], image_size=(640, 480), register=restless) for one in (1, 2, 3)]
    fly(nodes, ring_links(3))
    assert all(node.result.consensus for node in nodes), "this registration is believed while it is at rest"

    nodes = [RingNode(boxes, one, [1, 2, 3], image_size=(640, 480), register=restless) for one in (1, 2, 3)]
    restless.first = nodes[0]._observer.marks
    fly(nodes, ring_links(3))
    assert len(turns) >= 2
    assert all(node.result.confidence > 0.9 for node in nodes)
    assert not any(node.result.consensus for node in nodes)


@pytest.mark.parametrize("wrong_row", [1, 2, 3])
def test_an_edge_that_was_wrong_in_the_first_lap_is_repaired(wrong_row):
    views = views_of(5, 4, seed=2)
    calls = []

    def wrong_once(source, target, *, prior=None):
        """One match of five, said with full confidence, so that four animals are put where none are."""
        found = align_marks(source, target, prior=prior)
        if np.allclose(source.centres[0], wrong_once.centre):
            calls.append(1)
            if len(calls) == 1:
                away = found.transform @ np.array([[1, 0, 40.0], [0, 1, -30.0], [0, 0, 1]])
                return replace(found, matches=found.matches[:1], transform=away, confidence=0.99)
        return found

    nodes = nodes_of(views, register=wrong_once)
    wrong_once.centre = nodes[wrong_row]._observer.marks.centres[0]
    fly(nodes, ring_links(4))
    assert len(calls) > 1
    assert is_ring_right(views, Answers(nodes))
    assert all(node.result.repaired and node.result.consensus for node in nodes)


def test_views_of_another_pod_are_no_consensus():
    views = [*views_of(5, 2, seed=3), views_of(5, 2, seed=4)[1]]
    assert not register_ring([view.boxes for view in views], image_size=IMAGE_SIZE).consensus


@pytest.mark.parametrize(
    ("hits", "misses", "doubted"), [(1, 0, False), (1, 1, True), (2, 3, False), (2, 10, True), (0, 3, False)]
)
def test_who_alone_or_nearly_alone_sees_an_animal_is_doubted(hits, misses, doubted):
    assert is_doubted(MapAnimal(0.0, 0.0, 9.0, 0.0, hits, misses, 1)) == doubted


def test_a_false_alarm_of_one_view_gets_no_identity():
    views = views_of(5, 3, seed=6)
    middle = np.array([[620.0, 470.0, 660.0, 490.0]])
    boxes = [view.boxes for view in views]
    boxes[1] = np.concatenate([boxes[1], middle])
    answer = register_ring(boxes, image_size=IMAGE_SIZE)
    assert answer.identities[1][-1] == -1
    assert (answer.identities[1][:-1] >= 0).all()


def test_a_false_alarm_stays_one_in_a_ring_of_many_laps_and_views():
    views = views_of(5, 7, seed=6)
    middle = np.array([[620.0, 470.0, 660.0, 490.0]])
    boxes = [
        np.concatenate([view.boxes, middle]) if row == 4 else view.boxes for row, view in enumerate(views)
    ]
    answer = register_ring(boxes, image_size=IMAGE_SIZE)
    assert answer.identities[4][-1] == -1
    assert answer.consensus


def test_an_animal_outside_every_other_view_has_an_id_of_its_own():
    views = views_of(5, 2, seed=8)
    far = np.array([[1200.0, 900.0, 1278.0, 958.0]])
    pose_scaled = [views[0].boxes / 2, np.concatenate([views[0].boxes / 2, far])]
    # The first camera's picture ends where the second's goes on.
    first = RingNode(pose_scaled[0], 1, [1, 2], image_size=(640, 480))
    second = RingNode(pose_scaled[1], 2, [1, 2], image_size=IMAGE_SIZE)
    fly([first, second], [(0, 1)])
    assert second.result.identities[-1] >= 0
    assert second.result.identities[:-1].tolist() == first.result.identities.tolist()


def test_a_ring_of_one_names_its_own():
    (view,) = views_of(4, 1, seed=1)
    answer = register_ring([view.boxes], image_size=IMAGE_SIZE)
    assert answer.consensus
    assert sorted(answer.identities[0].tolist()) == [0, 1, 2, 3]


def test_no_boxes_anywhere_is_an_empty_map():
    answer = register_ring([np.zeros((0, 4))] * 3, image_size=IMAGE_SIZE)
    assert [len(one) for one in answer.identities] == [0, 0, 0]
    assert answer.memory.animals == ()


def test_a_drone_without_a_view_passes_the_map_on():
    views = views_of(5, 3, seed=9)
    boxes = [views[0].boxes, np.zeros((0, 4)), views[2].boxes]
    answer = register_ring(boxes, image_size=IMAGE_SIZE)
    views[1] = type(views[1])(np.zeros((0, 4)), np.zeros(0, dtype=int), views[1].pose)
    assert is_ring_right(views, answer)


@pytest.mark.parametrize("blind_row", [0, 1])
def test_a_drone_that_had_no_frame_confirms_nothing(blind_row):
    views = views_of(5, 2, seed=9)
    nodes = [
        RingNode(
            np.zeros((0, 4)) if row == blind_row else view.boxes,
            *(row + 1, [1, 2], EPISODE, PROPOSER),
            image_size=IMAGE_SIZE,
            is_blind=row == blind_row,
        )
        for row, view in enumerate(views)
    ]
    fly(nodes, ring_links(2))
    assert not any(node.result.consensus for node in nodes)


def test_a_line_ends_as_a_ring_does():
    views = views_of(5, 4, seed=10)
    ring, line = nodes_of(views), nodes_of(views)
    fly(ring, ring_links(4))
    fly(line, [*ring_links(4)[1:3], (0, 1)])
    assert [n.result.identities.tolist() for n in line] == [n.result.identities.tolist() for n in ring]
    assert all(node.result.consensus for node in line)


@settings(deadline=None, max_examples=6)
@given(st.integers(0, 2**32 - 1))
def test_loss_repeats_and_disorder_cost_only_time(seed):
    views = views_of(4, 3, seed=11)
    rng = np.random.default_rng(seed)
    old = []

    def unkind(packets):
        old.extend(packets)
        kept = [packet for packet in packets if rng.uniform() > 0.5]
        kept += [old[index] for index in rng.integers(len(old), size=2)] if old else []
        kept += [bytes(rng.integers(0, 256, 30, dtype=np.uint8))]
        return [kept[index] for index in rng.permutation(len(kept))]

    plain, tried = nodes_of(views), nodes_of(views)
    fly(plain, ring_links(3))
    fly(tried, ring_links(3), deliver=unkind)
    assert [n.result.identities.tolist() for n in tried] == [n.result.identities.tolist() for n in plain]
    assert tried[0].packets_refused > 0


@pytest.mark.parametrize("lost", [0, 1, 2])
@pytest.mark.parametrize("after_rounds", [0, 2])
def test_a_member_that_dies_is_passed_over(lost, after_rounds):
    views = views_of(4, 3, seed=12)
    nodes = nodes_of(views)
    inboxes = [[] for _ in nodes]
    for _ in range(after_rounds):
        said = [node.step(inbox, 0.0) for node, inbox in zip(nodes, inboxes, strict=True)]
        inboxes = [said[row - 1] + said[(row + 1) % 3] for row in range(3)]
    survivors = [row for row in range(3) if row != lost]
    for row in survivors:
        nodes[row].drop_member(nodes[lost].drone_id)
        nodes[row].step(inboxes[row], 0.0)
    left = [nodes[row] for row in survivors]
    fly(left, [(0, 1)])
    assert is_ring_right([views[row] for row in survivors], Answers(left))


@pytest.mark.parametrize("data", [b"", b"\x01", bytes(HEADER_BYTES), b"\xff" * 40])
def test_rubbish_is_counted_and_dropped(data):
    node = nodes_of(views_of(3, 2, seed=1))[1]
    assert node.step([data], 0.0) == []
    assert node.packets_refused == 1


def test_packets_of_another_episode_are_dropped():
    views = views_of(3, 2, seed=1)
    other = RingNode(views[0].boxes, 1, [1, 2], EPISODE + 1, PROPOSER, image_size=IMAGE_SIZE)
    node = nodes_of(views)[1]
    assert node.step(other.step([], 0.0), 0.0) == []
    assert node.packets_refused == 1


def test_a_node_refuses_a_roster_that_it_is_not_in():
    with pytest.raises(ValueError, match="drone 3"):
        RingNode(np.zeros((0, 4)), 3, [1, 2])
    with pytest.raises(ValueError, match="each member once"):
        RingNode(np.zeros((0, 4)), 1, [1, 1])
    with pytest.raises(RuntimeError, match="still runs"):
        _ = RingNode(np.zeros((0, 4)), 1, [1, 2]).result
    with pytest.raises(ValueError, match="views is empty"):
        register_ring([])


def test_bytes_sent_is_what_was_said():
    nodes = nodes_of(views_of(3, 2, seed=1))
    total, inboxes = [0, 0], [[], []]
    while not all(node.finished for node in nodes):
        said = [node.step(inbox, 0.0) for node, inbox in zip(nodes, inboxes, strict=True)]
        total = [sum(map(len, packets)) + before for packets, before in zip(said, total, strict=True)]
        inboxes = [said[1], said[0]]
    assert [node.bytes_sent for node in nodes] == total


def test_the_map_tells_each_drone_where_it_is():
    rng = np.random.default_rng(13)
    views = views_of(6, 4, seed=13)
    geometry = [geometry_of(view, rng) for view in views]
    nodes = [
        RingNode(views[k].boxes, k + 1, [1, 2, 3, 4], image_size=IMAGE_SIZE, view=geometry[k])
        for k in range(4)
    ]
    fly(nodes, ring_links(4))
    assert is_ring_right(views, Answers(nodes))
    first = views[0].pose
    turn = geometry[0].yaw_rad - first.yaw_rad
    scale = geometry[0].height_m / first.height_m
    for node, view in zip(nodes, views, strict=True):
        # The map is the world as the first drone believes it: turned by its compass error about itself.
        away = np.array([view.pose.n_m - first.n_m, view.pose.e_m - first.e_m]) * scale
        cos, sin = np.cos(turn), np.sin(turn)
        expected = np.array([cos * away[0] - sin * away[1], sin * away[0] + cos * away[1]])
        expected += (geometry[0].n_m, geometry[0].e_m)
        assert node.result.has_pose
        np.testing.assert_allclose([node.result.n_m, node.result.e_m], expected, atol=4.0)
        assert abs(np.angle(np.exp(1j * (node.result.yaw_rad - view.pose.yaw_rad - turn)))) < np.deg2rad(4.0)
    centre = nodes[1].result.transform @ np.array([640.0, 480.0, 1.0])
    assert np.isfinite(centre).all()


def test_ids_persist_while_the_pod_moves_and_one_is_away():
    rng = np.random.default_rng(14)
    views = views_of(6, 3, seed=14)
    memory, named = None, {}
    for episode in range(4):
        shown = [view.boxes[view.animals != 0] if episode in (1, 2) else view.boxes for view in views]
        animals = [view.animals[view.animals != 0] if episode in (1, 2) else view.animals for view in views]
        # The whole picture drifts and each animal by a fraction of its length.
        moved = [boxes + rng.normal(0, 4, (len(boxes), 2))[:, [0, 1, 0, 1]] + 15 * episode for boxes in shown]
        answer = register_ring(moved, memory=memory, now_s=100.0 * episode)
        for seen, identities in zip(animals, answer.identities, strict=True):
            for animal, number in zip(seen.tolist(), identities.tolist(), strict=True):
                assert named.setdefault(animal, number) == number
        memory = answer.memory
    assert sorted(named.values()) == [0, 1, 2, 3, 4, 5]


def test_an_id_comes_back_only_after_ten_minutes():
    view = views_of(3, 1, seed=1)[0]
    gone = Memory((MapAnimal(300.0, 300.0, 4.0, 0.0, 2, 0, 0),), (0.0,))
    early = register_ring(
        [view.boxes], memory=gone, now_s=599.0, register=lambda s, t, *, prior=None: no_match(s, t)
    )
    late = register_ring([view.boxes], memory=gone, now_s=601.0)
    assert sorted(early.identities[0].tolist()) == [1, 2, 3]
    assert sorted(late.identities[0].tolist()) == [0, 1, 2]


def no_match(source, target):
    none = np.zeros((0, 2), dtype=int)
    return BoxAlignment(np.eye(3), none, np.arange(len(source)), np.arange(len(target)), 0.0, 0.0, False, 0)


def test_more_boxes_than_a_packet_holds_is_no_error():
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 900, (60, 2))
    boxes = np.concatenate([corners, corners + rng.uniform(10, 40, (60, 2))], axis=1)
    answer = register_ring([boxes], image_size=IMAGE_SIZE)
    assert (answer.identities[0] >= 0).sum() == MAX_ANIMALS


def test_a_member_that_was_passed_over_while_it_lived_says_its_word_anew():
    centres = np.array([[150, 150], [450, 120], [300, 300], [520, 380], [120, 400]], float)
    sides = np.array([[30, 60], [50, 35], [40, 40], [60, 30], [35, 55]], float)
    boxes = np.hstack([centres - sides / 2, centres + sides / 2])
    shown = (boxes[:3], boxes, boxes[:3])  # the second alone sees two more
    nodes = [RingNode(seen, k + 1, [1, 2, 3], image_size=IMAGE_SIZE) for k, seen in enumerate(shown)]
    first = nodes[0].step([], 0.0)
    nodes[2].drop_member(2)  # the third takes the second for lost and goes on with the first's map
    said = [first, nodes[1].step(first, 0.0), nodes[2].step(first, 0.0)]
    for _ in range(20):
        said = [node.step(said[k - 1] + said[(k + 1) % 3], 0.0) for k, node in enumerate(nodes)]
    assert all(node.finished for node in nodes)
    assert [len({*node.result.identities.tolist()} - {-1}) for node in nodes] == [3, 3, 3]
