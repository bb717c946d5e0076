# Public names of this room. Written by .ci/public_names.py from the front door's.

from .dataset.export import ExportFormat as ExportFormat
from .dataset.export import ExportSummary as ExportSummary
from .dataset.export import export_dataset as export_dataset
from .dataset.making import DatasetSummary as DatasetSummary
from .dataset.making import make_dataset as make_dataset
from .dataset.plan import DatasetPlan as DatasetPlan
from .dataset.plan import plan_dataset as plan_dataset
from .networks import Network as Network
