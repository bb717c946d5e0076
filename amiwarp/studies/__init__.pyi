# Public names of this room. Written by .ci/public_names.py from the front door's.

from .evaluate.evaluation import EvaluationSummary as EvaluationSummary

# Names that are in this room only, kept by hand: what people who add to it need.

from .design import Design as Design
from .design import Limits as Limits
from .design import Timing as Timing
