"""The registry of drives, a row for each kind, and `stick_slip_drive`, which makes a smooth drive truly stick."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pneuopt.models.declaration import Drive, DriveKind
from pneuopt.models.drives import FORCE_KIND, MOTION_KIND, ROTARY_KIND
from pneuopt.models.friction import Karnopp
from pneuopt.models.linear import LINEAR_KIND
from pneuopt.models.pneumatic.drive import PNEUMATIC_KIND
from pneuopt.quantities.errors import ModelError

DRIVE_KINDS: Mapping[str, DriveKind] = {
    kind.name: kind for kind in (PNEUMATIC_KIND, FORCE_KIND, MOTION_KIND, LINEAR_KIND, ROTARY_KIND)
}


def stick_slip_drive(drive: Drive) -> Drive:
    """The drive with Karnopp's friction where its own is a static map with a Coulomb level; else as it is.

    Returns
    -------
    drive
        For simulation: with bristles it is the drive itself, as they stick by themselves, and with viscous friction,
        which never does.

    Examples
    --------
    >>> from pneuopt.models.drives import ForceDrive
    >>> from pneuopt.models.friction import Coulomb
    >>> type(stick_slip_drive(ForceDrive(Coulomb())).friction).__name__
    'Karnopp'
    """
    friction = getattr(drive, "friction", None)
    if friction is None or not DRIVE_KINDS[drive.kind].any_friction:
        return drive
    try:
        sticking: Any = Karnopp(friction)
    except ModelError:
        return drive
    same: Any = drive
    return replace(same, friction=sticking)  # type: ignore[no-any-return]
