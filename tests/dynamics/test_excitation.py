from pneuopt.dynamics.excitation import Excitation


def test_parameters_in_order_keep_their_order_in_a_plant() -> None:
    own = Excitation(at_least={"static": "coulomb"}) | Excitation(at_least={"second": "load.force"})
    assert own.with_prefix("friction").at_least == {
        "friction.static": "friction.coulomb",
        "friction.second": "load.force",
    }
