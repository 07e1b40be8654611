"""Terms, and the systems that sum them."""

from nnode.models.build import MODELS, build_model
from nnode.models.crowd import InteractionForce, NetworkForce, Relaxation, SocialForce
from nnode.models.network import FeedForward
from nnode.models.scene import Scene
from nnode.models.system import Crowd, System, Traffic
from nnode.models.term import Interval, State, Term
from nnode.models.traffic import FollowTheLeader, Linear, Logarithmic, NetworkSpeed

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
