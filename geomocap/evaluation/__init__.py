"""How far a run is from the truth: a synthetic capture's, or another system's markers and joints."""

from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.evaluation.result import Alignment, Curve, Evaluation, Match
from geomocap.evaluation.run_evaluation import evaluate

__all__ = ["Alignment", "Curve", "Evaluation", "EvaluationSettings", "Match", "evaluate"]
