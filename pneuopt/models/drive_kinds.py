"""The registry of drives, a row for each kind: files and the command line read drives through it."""

from collections.abc import Mapping

from pneuopt.models.declaration import DriveKind
from pneuopt.models.drive import FORCE_KIND, MOTION_KIND
from pneuopt.models.linear import LINEAR_KIND
from pneuopt.models.pneumatic.drive_file import PNEUMATIC_KIND
from pneuopt.models.rotary import ROTARY_KIND

DRIVE_KINDS: Mapping[str, DriveKind] = {
    kind.name: kind
    for kind in (
        PNEUMATIC_KIND,
        FORCE_KIND,
        MOTION_KIND,
        LINEAR_KIND,
        ROTARY_KIND,
    )
}
