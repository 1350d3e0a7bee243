"""`BLOCK_FORMS`: the PID blocks of common controllers by their makers, where a new one is registered."""

from collections.abc import Mapping
from enum import Enum

from pneuopt.export.makers import beckhoff, codesys, rockwell, siemens, simulink
from pneuopt.export.makers.block_form import BlockForm


class Block(Enum):
    """Whose PID block takes the gains."""

    SIEMENS = "siemens"
    ROCKWELL = "rockwell"
    BECKHOFF = "beckhoff"
    CODESYS = "codesys"
    SIMULINK = "simulink"


BLOCK_FORMS: Mapping[Block, BlockForm] = {
    Block.SIEMENS: siemens.SIEMENS_FORM,
    Block.ROCKWELL: rockwell.ROCKWELL_FORM,
    Block.BECKHOFF: beckhoff.BECKHOFF_FORM,
    Block.CODESYS: codesys.CODESYS_FORM,
    Block.SIMULINK: simulink.SIMULINK_FORM,
}
"""What is known of each block."""
