"""Places that are seen again: recognised by descriptors, verified by pixels, linked once others say the same.

In reading order: `recogniser` (what recognises, as others see it), `faiss_index` (votes of landmarks), `verification`
(is it the same place?), `second_pose` (would another pose explain it as well?), `revisits` (when is it asked, believed,
linked?).
"""

from dualslam.places.faiss_index import FaissRecogniser
from dualslam.places.recogniser import PlaceCandidate, PlaceRecogniser
from dualslam.places.second_pose import SecondSimilarity, find_second_pose
from dualslam.places.verification import PlaceMatch, PlaceVerifier

__all__ = [
    "FaissRecogniser",
    "PlaceCandidate",
    "PlaceMatch",
    "PlaceRecogniser",
    "PlaceVerifier",
    "SecondSimilarity",
    "find_second_pose",
]
