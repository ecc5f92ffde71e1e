"""Revisited places: recognised by descriptors, verified by pixels, linked once other keyframes agree.

In reading order:

- `recogniser`: what a recogniser offers. `faiss_index`: the one that counts votes of landmarks.
- `verification`: is it the same place? `second_pose`: would another pose explain it as well?
- `revisits`: when to ask, believe and link.
"""

from dualslam.places.faiss_index import FaissRecogniser
from dualslam.places.recogniser import PlaceCandidate
from dualslam.places.sides import SecondSimilarity, find_second_pose
from dualslam.places.verification import PlaceMatch, PlaceVerifier

__all__ = ["FaissRecogniser", "PlaceCandidate", "PlaceMatch", "PlaceVerifier", "SecondSimilarity", "find_second_pose"]
