"""Options of a simulated run: values, defaults, and refused requests."""

from __future__ import annotations

import pytest

from pipeline.errors import SourceError
from pipeline.simulation.scenarios import parse_uri


def test_defaults_are_those_of_the_scenario():
    request = parse_uri("sim:stand", seed=4)
    assert (request.name, request.seed, request.sigma) == ("stand", 4, 0.02)
    assert (request.odometry, request.duration_s, request.trees) == ("normal", 75.0, 52)
    assert parse_uri("stand", seed=4) == request


def test_every_option_is_taken_and_the_seed_of_the_uri_wins():
    request = parse_uri("sim:stand?seed=3&sigma=0.03&odometry=poor&duration=30&trees=20", seed=9)
    assert (request.seed, request.sigma, request.odometry) == (3, 0.03, "poor")
    assert (request.duration_s, request.trees) == (30.0, 20)
    assert request.scenario.trees == 20


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("sim:jungle", "Scenarios: sim:stand, sim:paper"),
        ("sim:stand?sede=3", "no option 'sede'.*Options: seed"),
        ("sim:stand?seed=3&seed=4", "given twice"),
        ("sim:stand?seed", "key=value"),
        ("sim:stand?seed=", "seed = ''"),
        ("sim:stand?seed=-1", "seed = '-1'"),
        ("sim:stand?seed=9223372036854775808", "seed"),
        ("sim:stand?seed=" + "9" * 5000, "seed"),
        ("sim:stand?seed=²", "seed"),
        ("sim:stand?sigma=nan", "sigma"),
        ("sim:stand?sigma=0.3", "0 to 0.2"),
        ("sim:stand?duration=٣٠", "duration"),
        ("sim:stand?odometry=perfect", "good, normal, poor, slipping, exact"),
        ("sim:stand?duration=0", "duration"),
        ("sim:stand?duration=1e9", "1 to 3600"),
        ("sim:stand?trees=2001", "0 to 2000"),
        ("sim:stand?drive=1001", "drive"),
        ("sim:paper?trees=8", "at most 7 trees"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(uri, message):
    with pytest.raises(SourceError, match=message) as refusal:
        parse_uri(uri)
    assert "\n" not in str(refusal.value)


def test_numbers_as_in_stored_addresses_are_read():
    request = parse_uri("sim:stand?seed=007&sigma=.05&duration=3e1")
    assert (request.seed, request.sigma, request.duration_s) == (7, 0.05, 30.0)


def test_a_seed_from_outside_is_checked_too():
    with pytest.raises(SourceError, match="seed"):
        parse_uri("sim:stand", seed=-1)
