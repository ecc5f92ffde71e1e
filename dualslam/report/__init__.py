"""Reports for a person: one self-contained page for a run, and one for several runs side by side.

In reading order: `run_data` (a run folder, read), `page` (the page, section by section), `top_view`, `timeline`,
`failures`, `places`, `charts` (its figures), `trust` (its doubts). `compare` (several runs), `samples` (pictures kept
as the run goes on), `markup` (how HTML is made so that text cannot break it). The figures are SVG written by hand:
crisp at any size, a few kilobytes, and no library is needed to make them.
"""

from dualslam.report.compare import comparison_page, comparison_table
from dualslam.report.page import report_page
from dualslam.report.run_data import RunData, read_run
from dualslam.report.samples import PlaceAlbum, SampleKeeper

__all__ = ["PlaceAlbum", "RunData", "SampleKeeper", "comparison_page", "comparison_table", "read_run", "report_page"]
