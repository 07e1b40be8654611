"""Terms, and the models that are sums of terms."""

from nnode.model.build import build_model
from nnode.model.laws import FollowTheLeader, InteractionForce, Law, make_law
from nnode.model.network import FeedForward
from nnode.model.scene import Scene
from nnode.model.system import Crowd, System, Traffic
from nnode.model.term import Interval, State, Term

__all__ = [
    "Crowd",
    "FeedForward",
    "FollowTheLeader",
    "InteractionForce",
    "Interval",
    "Law",
    "Scene",
    "State",
    "System",
    "Term",
    "Traffic",
    "build_model",
    "make_law",
]
