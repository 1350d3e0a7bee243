"""The channels that the log of a plant may hold beside the usual ones."""

from typing import Protocol

from pneuopt.quantities.parameters import Quantity


class Plant(Protocol):
    """What a log's reader asks of a plant, say a `System`."""

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Signals that drive it."""
        ...

    @property
    def outputs(self) -> tuple[Quantity, ...]:
        """Signals that sensors show."""
        ...


def plant_channels(plant: Plant) -> dict[str, str]:
    """The channels that a plant's log may hold: its signals, and the references of its outputs."""
    references = {f"{q.name}_reference": q.unit for q in plant.outputs}
    return {**{q.name: q.unit for q in (*plant.inputs, *plant.outputs)}, **references}
