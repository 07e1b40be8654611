"""Terms, and the systems that sum them."""

from nnode.model.build import MODELS, build_model
from nnode.model.crowd import InteractionForce, NetworkForce, Relaxation, SocialForce
from nnode.model.network import FeedForward
from nnode.model.scene import Scene
from nnode.model.system import Crowd, System, Traffic
from nnode.model.term import Interval, State, Term
from nnode.model.traffic import FollowTheLeader, Linear, Logarithmic, NetworkSpeed

__all__ = [
    "MODELS",
    "Crowd",
    "FeedForward",
    "FollowTheLeader",
    "InteractionForce",
    "Interval",
    "Linear",
    "Logarithmic",
    "NetworkForce",
    "NetworkSpeed",
    "Relaxation",
    "Scene",
    "SocialForce",
    "State",
    "System",
    "Term",
    "Traffic",
    "build_model",
]
