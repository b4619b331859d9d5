"""How far a run is from the truth: a synthetic capture's, or another system's markers and joints."""

from geomocap.evaluation.evaluate import evaluate
from geomocap.evaluation.result import Alignment, Curve, Evaluation, Match
from geomocap.evaluation.settings import EvaluationSettings

__all__ = ["Alignment", "Curve", "Evaluation", "EvaluationSettings", "Match", "evaluate"]
