"""The rig of each mode."""

from hil.run.inprocess import InprocessRig
from hil.run.lockstep import LockstepRig
from hil.run.realtime_rig import RealtimeRig
from hil.run.rig import Rig

RIGS: dict[str, type[Rig]] = {rig.mode: rig for rig in (LockstepRig, InprocessRig, RealtimeRig)}
