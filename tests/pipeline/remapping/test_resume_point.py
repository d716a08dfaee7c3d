"""A rerun that goes on from a run with other parameters gives, to the byte, what one from the start gives."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from app.worker.remap import Remapping, Told
from pipeline.config import Parameters, field_specs
from pipeline.errors import StemmapError
from pipeline.mapper import MapperState
from pipeline.remapping import Basis, Journal, KeptScans, Recalled, Rerun
from pipeline.remapping.journal import FARTHEST, STRETCH
from pipeline.types.records import Frame
from tests.pipeline.remapping.mapped import BASE, mapper, run, with_odd
from tests.pipeline.remapping.test_rerun import another

SETS = 8
LATE = ("detection.", "tracking.", "classification.tree_share", "evaluation.", "obstacles.")


def told(known: object) -> object:
    """Everything that a record holds, bit by bit."""
    if is_dataclass(known):
        return tuple(told(getattr(known, f.name)) for f in fields(known))
    if isinstance(known, list | tuple):
        return tuple(map(told, known))
    if isinstance(known, np.ndarray):
        return (known.dtype.str, known.shape, known.tobytes())
    return repr(known)


def finished(
    parameters: Parameters, kept: KeptScans, basis: Basis | None
) -> tuple[Rerun, object, dict[int, object]]:
    """A rerun at its end, all that its mapper knows then, and the trees after each scan."""
    rerun = Rerun(mapper(parameters), kept, None, basis)
    trees: dict[int, object] = {}
    while rerun.done < len(kept):  # scans of which the trees alone are tracked come many at once
        trees |= {f.index: told(f.trees) for f in rerun.frames(rerun.done + 1)}
    m = rerun.mapper
    state: MapperState | None = rerun.state()
    assert state is not None
    return rerun, told((state, m.path, m.height_map)), trees


def remembered(frames: Iterable[Frame | Recalled]) -> object:
    """What is remembered of the trees of a run beside its map, all of it."""
    known = Told()
    for frame in frames:
        known.record(frame, 0)
    every = known.history
    return told((every._rows[: every._count], tuple(sorted(known.confirmed_s.items())), known.time_s))


def drawn(seed: int) -> Parameters:
    """The preset with one to three parameters drawn anew that are asked behind the finding of clusters."""
    rng = np.random.default_rng(seed)
    late = [spec for spec in field_specs() if spec.name.startswith(LATE) and spec.name != "tracking.engine"]
    while True:
        chosen = [late[int(k)] for k in rng.choice(len(late), rng.integers(1, 4), replace=False)]
        try:
            return BASE.replace({s.name: another(s, float(rng.uniform(0.02, 0.5))) for s in chosen})
        except StemmapError:
            continue


@pytest.mark.parametrize("seed", range(SETS))
def test_what_goes_on_is_what_begins_anew(seed, known):
    kept, basis = known
    parameters = drawn(seed)
    _, wanted, trees = finished(parameters, kept, None)
    rerun, given, recalled = finished(parameters, kept, basis)
    assert given == wanted
    assert recalled == {k: v for k, v in trees.items() if k >= rerun.passed}
    assert len(rerun.journal) == len(kept)


@pytest.mark.parametrize("most", [1, 7, 1000])
@pytest.mark.parametrize("change", [{"tracking.hits_to_confirm": 9}, {"classification.tree_share": 0.7}])
def test_the_same_is_remembered_of_scans_that_are_told_many_at_a_time(change, most, known, monkeypatch):
    monkeypatch.setattr("app.explain.estimate_history._MOST_ROWS", 150)
    kept, basis = known
    again = Rerun(mapper(BASE.replace(change)), kept, None, basis)
    frames: list[Frame | Recalled] = []
    while again.done < len(kept):
        frames += again.frames(min(again.done + most, len(kept)))
    assert len(frames) < len(kept) or most == 1
    assert all(isinstance(frame, Recalled) for frame in frames)
    whole = mapper(BASE.replace(change))
    wanted = remembered(whole.process(step) for step in run()[0])
    assert remembered(frames) == wanted


@pytest.mark.parametrize(
    ("name", "value", "alone"),
    [
        ("tracking.gate", 2.5, True),
        ("tracking.hits_to_confirm", 9, True),
        ("classification.tree_share", 0.7, True),
        ("slam.gate", 3.0, False),
        ("classification.every", 2, False),
        ("clustering.eps", 0.2, False),
        ("tracking.engine", "filterpy", False),
    ],
)
def test_trees_alone_are_tracked_where_nothing_before_them_changes(name, value, alone, known):
    kept, basis = known
    scans, anew = basis.begin(BASE.replace({name: value}), kept.clusters)
    assert (scans, anew) == ((len(kept), True) if alone else (0, False))


def test_a_journal_of_a_rerun_is_one_of_its_parameters(known):
    """One change after another, each from the run before."""
    kept, basis = known
    first, second = BASE.replace({"tracking.gate": 2.5}), BASE.replace({"classification.tree_share": 0.7})
    again, _, _ = finished(first, kept, basis)
    last = again.state()
    assert last is not None
    states = {0: mapper(first).snapshot(), len(kept): last}
    after = replace(basis, parameters=first, notes=again.journal.first(len(kept)), states=states)
    assert finished(second, kept, after)[1] == finished(second, kept, None)[1]


def test_a_verdict_that_changes_late_is_begun_late(known):
    kept, basis = known
    scans = len(kept)
    clusters, detection = kept.clusters, BASE.detection
    assert clusters.first_judged_otherwise(detection, detection, scans) == scans
    longest = clusters._columns["eccentricity"]
    rows = np.flatnonzero(clusters.verdicts(detection, scans) == 0)
    last = rows[rows >= clusters.start[scans - 10]]
    limit = float(longest[last].max())
    tried = detection.model_copy(update={"e_max": limit * 0.999})
    first = clusters.first_judged_otherwise(detection, tried, scans)
    judged = clusters.verdicts(tried, scans) != clusters.verdicts(detection, scans)
    assert first == np.searchsorted(clusters.start, np.flatnonzero(judged)[0], side="right") - 1
    begun, anew = basis.begin(BASE.replace({"detection.e_max": tried.e_max}), clusters)
    assert not anew
    assert begun == max(k for k in basis.states if k <= first)


def test_a_scan_that_hung_on_the_trees_is_mapped(known):
    kept, basis = known
    later = BASE.replace({"tracking.gate": 2.5})
    broken = with_odd(basis, np.arange(len(kept)) == 30)
    assert broken.begin(later, kept.clusters) == (28, True)
    assert finished(later, kept, broken)[1] == finished(later, kept, None)[1]


def test_no_more_scans_are_mapped_at_once_where_the_trees_alone_no_longer_do(known):
    kept, basis = known
    broken = with_odd(basis, np.arange(len(kept)) == 30)
    remapping = Remapping(Rerun(mapper(BASE.replace({"tracking.gate": 2.5})), kept, None, broken), 0)
    done = []
    while not remapping.work(5, 40):
        done.append(remapping.rerun.done)
    assert done == [28, 33, 38]


@pytest.mark.parametrize("room", [0.0, 0.13, 0.999, 1.0])
def test_a_journal_without_room_ends_and_one_that_goes_back_is_cut(room, known):
    _, basis = known
    whole, size = mapper(BASE), basis.notes.nbytes
    small = Journal(most=round(room * size))
    whole.note = lambda noted: small.note(noted, BASE.slam)
    for step in run()[0]:
        whole.process(step)
    kept = small.first(len(run()[0]))
    assert kept.nbytes <= room * size
    assert told(small.first(len(run()[0]))) == told(kept)
    assert (len(kept) == len(basis.notes)) == (room == 1.0)
    assert told(kept) == told(basis.notes.first(len(kept)))
    if room == 0.13:
        assert 0 < len(kept) < len(basis.notes)
    small.cut(len(kept) // 2)
    assert len(small) == len(small.first(1000)) == len(kept) // 2


def test_asking_a_journal_leaves_no_short_stretches(known):
    _, basis = known
    whole, journal = mapper(BASE), Journal()
    whole.note = lambda noted: journal.note(noted, BASE.slam)
    for step in run()[0]:
        whole.process(step)
        assert len(journal.first(step.index + 1)) == step.index + 1
    assert len(journal.first(1000).stretches) == -(-len(basis.notes) // STRETCH)
    assert told(journal.first(1000)) == told(basis.notes)


def test_no_tree_can_be_held_to_a_landmark_that_is_not_noted():
    bounds = [s.maximum for s in field_specs() if s.name == "tracking.distance_max"]
    assert [bound is not None and bound <= FARTHEST for bound in bounds] == [True]
