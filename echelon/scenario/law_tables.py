"""The tables of a scenario that concern the control law and avoidance."""

from typing import Annotated, Literal

from pydantic import Field, SerializationInfo, field_serializer, model_validator

from echelon.parameters import Positive
from echelon.scenario.part_fields import LawName, LawParameters, WrittenLawName, written_use
from echelon.scenario.values import CouplingGain, Flag, Fraction, Gain, Table


class Gains(Table):
    """Gains of blocks before division by their time scale σ: K_1 = k1/σ², K_2 = k2/σ (docs/architecture.md, 2.4)."""

    block: str = "*"
    """The blocks: a name (`g1`, `inter`, `centroid`), a layer (`intra`), or `*`"""
    k1: Gain = 1.0
    """Gain of the error: a number, or a full matrix of the block"""
    k2: Gain = 1.0
    """Gain of the error's rate: a number, or a full matrix of the block"""


class Coupling(Table):
    """Velocity coupling K̄: the error rates of one block act on another block (docs/architecture.md, 2.4)."""

    block: str = "*"
    """The blocks that are acted on: a name, a layer, or `*`"""
    onto: str = "*"
    """The blocks whose error rates act: a name, a layer, or `*`"""
    value: CouplingGain
    """Entries of K̄ for each pair of these blocks: a number for every entry, or the full matrix"""


class Law(Table):
    """The control law: time scales, gains and coupling of the blocks.  The blocks are the shapes of all nodes and the centroid
    (docs/architecture.md, 2.4)."""

    use: LawName = Field(default="linear", validate_default=True)
    """`linear` (the paper's), `integral`, `terminal_sliding`, or a law of your own (docs/add-a-law.md)"""
    parameters: LawParameters = Field(default_factory=dict, validate_default=True)
    """Parameters of the law that `use` names"""  # validation turns them into the law itself, a Part
    time_scales: Literal["three", "multi"] = "three"
    """`three`: one time scale for each layer of the tree.  `multi`: one for each node; the groups settle in their order"""
    epsilon: Annotated[list[Annotated[float, Field(strict=True, gt=0, le=1)]], Field(min_length=1)] = [0.7, 0.7]
    """ε_1, ε_2, …: the time scale σ of a block is the product of the first few.  `three` needs as many as the tree has layers
    of nodes, `multi` as many as there are nodes: the groups and the formation"""
    gains: list[Gains] = []
    """Gains of blocks, for laws that use them; later entries override earlier ones"""
    coupling: list[Coupling] = []
    """Coupling of blocks; later entries override earlier ones.  Without entries no block is coupled"""
    lead: Fraction = 0.0
    """λ, how far ahead the law looks, in acceleration periods, for laws that use it (docs/architecture.md, 2.5).  With 0 the
    law does not look ahead; 0.5 compensates for the hold of the accelerations"""
    reference: Literal["message", "now"] = "message"
    """The reference that a state is compared with (docs/architecture.md, 2.5).  `message`: that of the time of the state's
    message.  `now`: that of the instant at which the node acts; then a delay τ leaves a steady lag, velocity × τ, in a moving
    formation"""

    @field_serializer("use")
    def _use(self, use: str, info: SerializationInfo) -> WrittenLawName:
        return written_use(self.parameters, info)


class Avoidance(Table):
    """Collision avoidance: a potential pushes robots apart that are closer than `sensing_radius` (docs/architecture.md,
    2.6)."""

    enabled: Flag = False
    """False: robots do not avoid each other; a distance of at most `avoidance_radius` is still a violation"""
    avoidance_radius: Positive = 0.25
    """r_a: a distance of two robots of at most this is a violation [m]"""
    sensing_radius: Positive = 1.0
    """R_s: two robots push each other apart if their distance is below this [m]"""
    force_limit: Positive = 1e4
    """Largest ∇f of one pair [m/s²]; it acts also within r_a, where the potential is not defined"""

    @model_validator(mode="after")
    def _radii(self) -> "Avoidance":
        if self.sensing_radius <= self.avoidance_radius:
            raise ValueError(
                f"sensing_radius = {self.sensing_radius} must be larger than avoidance_radius = {self.avoidance_radius}"
            )
        return self
