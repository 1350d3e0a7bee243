import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneuopt.quantities.errors import InputError, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 1.0, 10.0, log=True),
        "friction.coulomb": Parameter(40.0, "N", 0.0, 100.0),
        "friction.viscous": Parameter(80.0, "N*s/m", source="a catalogue"),
    }
)


@pytest.mark.parametrize("fields", [{"nominal": 0.0}, {"nominal": -1.0}, {"lower": 1.0, "upper": 1.0}])
def test_a_bad_quantity_is_refused_by_name(fields: dict[str, float]) -> None:
    with pytest.raises(InputError, match="speed"):
        Quantity("speed", "m/s", **fields)


def test_edits_are_copies_and_keep_the_rest() -> None:
    edited = RIG.freed("friction.*").with_values({"load.mass": 6.0}).with_bounds({"friction.coulomb": (10.0, 50.0)})
    assert edited.free_names == ("friction.coulomb", "friction.viscous")
    assert (edited.value("load.mass"), RIG.value("load.mass")) == (6.0, 5.0)
    assert (edited["friction.coulomb"].lower, edited["friction.viscous"].source) == (10.0, "a catalogue")
    assert RIG.free_names == ()
    assert edited.fixed("*").free_names == ()
    assert edited.fixed("friction.viscous").free_names == ("friction.coulomb",)
    assert edited.per_log("load.mass")["load.mass"].per_log


def test_a_pattern_without_a_match_is_an_error() -> None:
    with pytest.raises(UnknownNameError, match="fricton"):
        RIG.freed("fricton.*")


def test_unknown_names_are_refused_everywhere() -> None:
    for call in (RIG.value, lambda n: RIG.with_values({n: 1.0}), lambda n: RIG.with_bounds({n: (0.0, 1.0)})):
        with pytest.raises(UnknownNameError, match=r"load\.mas"):
            call("load.mas")


def test_get_gives_the_default_for_a_name_that_is_not_there_as_every_mapping_does() -> None:
    assert RIG.get("load.mas") is None
    assert RIG.get("load.mas", RIG["load.mass"]) is RIG["load.mass"]
    assert RIG.get("load.mass") is RIG["load.mass"]


def test_a_value_outside_its_bounds_names_the_parameter() -> None:
    with pytest.raises(InputError, match=r"load\.mass"):
        RIG.with_values({"load.mass": 50.0})
    with pytest.raises(InputError, match=r"friction\.coulomb"):
        RIG.with_bounds({"friction.coulomb": (50.0, 60.0)})


def test_joining_lets_the_right_win_and_keeps_the_order() -> None:
    joined = RIG | ParameterSet({"load.mass": Parameter(7.0, "kg"), "pid.Kp": Parameter(1.0, "1")})
    assert tuple(joined) == (*RIG, "pid.Kp")
    assert joined.value("load.mass") == 7.0


def test_equal_sets_have_equal_hashes_whatever_their_order() -> None:
    turned = ParameterSet(reversed(list(RIG.items())))
    assert turned == RIG
    assert hash(turned) == hash(RIG)


def test_it_prints_and_tabulates_everything() -> None:
    text = repr(RIG.freed("load.mass"))
    assert "load.mass         5 kg in [1, 10] free, log" in text
    assert "# a catalogue" in text
    frame = RIG.to_frame()
    assert list(frame.index) == list(RIG)
    assert frame.loc["load.mass", "unit"] == "kg"


def test_it_travels_between_processes() -> None:
    assert pickle.loads(pickle.dumps(RIG)) == RIG


@given(st.lists(st.sampled_from(list(RIG)), unique=True))
def test_selecting_keeps_the_order_asked_for(names: list[str]) -> None:
    assert list(RIG.select(names)) == names
    assert list(RIG.select(names).with_prefix("rig")) == [f"rig.{n}" for n in names]


def test_a_meaning_does_not_tell_parameters_apart_and_stays_with_a_copy() -> None:
    mass = Parameter(5.0, "kg", meaning="mass that moves")
    assert mass == Parameter(5.0, "kg")
    assert ParameterSet({"load.mass": mass}).with_values({"load.mass": 6.0})["load.mass"].meaning == "mass that moves"
