"""The failure lab: seeded corruptions of any sequence, and faults inside the system, from a few lines of YAML.

    - {kind: blackout, start: 100, length: 10}
    - {kind: occlusion, start: 150, length: 30, strength: 0.5, seed: 3}

`Corruption` (in the core, as it is part of the configuration) says what can be done. Where a run is made from a config,
`CorruptedSequence` stands before its sequence and a `FaultScript` around the system's parts.
"""

from dualslam.core.config.corruption import Cause, Corruption, CorruptionKind
from dualslam.lab.disturbances.faults import FaultScript
from dualslam.lab.disturbances.overlays import hidden_by
from dualslam.lab.disturbances.sequence import CorruptedSequence, corrupted

__all__ = ["Cause", "CorruptedSequence", "Corruption", "CorruptionKind", "FaultScript", "corrupted", "hidden_by"]
