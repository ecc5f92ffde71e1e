"""Revisited places: recognised by descriptors, verified by pixels, linked once other keyframes agree.

In reading order:

- `recogniser`: what a recogniser offers. `faiss_index`: the one that counts votes of landmarks.
- `verification`: is it the same place? `sides`: the landmarks about it; would another pose explain it as well?
- `plausibility`: can it be there? `sightings`: a submap found again by pixels.
- `revisits`: when to ask, believe and link. `set_joins`: maps apart at the end, joined by all that they share.
"""

from dualslam.places.faiss_index import FaissRecogniser
from dualslam.places.recogniser import PlaceCandidate
from dualslam.places.sides import SecondSimilarity, find_second_pose
from dualslam.places.verification import PlaceMatch, PlaceVerifier

__all__ = ["FaissRecogniser", "PlaceCandidate", "PlaceMatch", "PlaceVerifier", "SecondSimilarity", "find_second_pose"]
