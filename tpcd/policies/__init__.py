"""Who chooses the next command: scripts, the paper's grid, and information gain."""

from tpcd.policies.active import ActivePolicy, ActiveSettings
from tpcd.policies.basic import GridPolicy, MotionPolicy
from tpcd.policies.limits import Limits
from tpcd.policies.named import make_policy
from tpcd.policies.protocol import Choice, Policy, Situation

__all__ = [
    "ActivePolicy",
    "ActiveSettings",
    "Choice",
    "GridPolicy",
    "Limits",
    "MotionPolicy",
    "Policy",
    "Situation",
    "make_policy",
]
