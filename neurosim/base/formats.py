"""What the JSON files of this program hold: every format, declared once.

A reader checks a file against one of these (:func:`neurosim.base.files.read_json`); a key with the
default None may be missing or null. Keys that are not declared are passed over.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from neurosim.base.declared import Coordinate, Fraction, MetresOrNone

#: Poses of results are no farther away, m, and turn no more, rad: pictures of them are drawn.
FARTHEST = 1e5
Far = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]
FarPose = tuple[Far, Far, Far]
#: How many rows or units; there may be none.
Whole = Annotated[int, Meta(ge=0, le=10**9)]
#: A size or an amount of noise, m or as a fraction.
Size = Annotated[float, Meta(ge=0, le=10)]
Amount = Annotated[float, Meta(ge=0, le=100)]
#: Of the delays of a robot, s.
Delay = Annotated[float, Meta(ge=0, le=1)]


class Format(Struct):
    """Base of all."""


#: Walls of arenas, m, and how many at most; obstacles, too.
MOST_SHAPES = 1000
Walls = Annotated[
    list[tuple[Coordinate, Coordinate, Coordinate, Coordinate]], Meta(max_length=MOST_SHAPES)
]
#: A pose, or where the robot was not seen.
Seen = tuple[float | None, float | None, float | None]
#: A command: its numbers in the robot's units, and behind them, in a plan, a duration in s.
CommandRow = Annotated[
    list[Annotated[float, Meta(ge=-1e6, le=1e6)]], Meta(min_length=2, max_length=64)
]
#: Of a picture, and of a camera.
Pixels = Annotated[int, Meta(ge=1, le=10**6)]
Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]


# What several hold


class Column(Format):
    """An input or output."""

    name: str
    unit: str | None = None


class CommandColumn(Format):
    """A number of a command."""

    name: str
    unit: str


class Robot(Format):
    """Which robot it was."""

    kind: str | None = None
    virtual: bool | None = None


class Source(Format):
    """What something was made of."""

    path: str | None = None
    name: str | None = None
    dataset: str | None = None
    sha256: str | None = None
    virtual: bool | None = None
    perimeter: Perimeter | None = None


class Board(Format):
    """Sides of a board, m."""

    length: float
    width: float
    line_inset: MetresOrNone | None = None
    line_width: MetresOrNone | None = None


class Perimeter(Format):
    """Where a guard ends drives: the board, the robot's light sensors, the margin, m."""

    board: Board
    sensors: Annotated[list[tuple[Coordinate, Coordinate]], Meta(max_length=100)]
    margin: MetresOrNone | None = None


class Stopped(Format):
    """What made the guard stop the robot."""

    code: Annotated[int, Meta(ge=1, le=3)]
    time: float
    command: int | None = None
    into: float = 0.0
    sensor: str | None = None
    pose: FarPose | None = None
    unseen_since: float | None = None


class Named(Format):
    """A task by its name."""

    name: str
    settings: dict[str, Any] | None = None


# Recordings and datasets


class Drives(Format):
    """What drove the robot."""

    controller: dict[str, Any] | None = None


class RecordedWith(Format):
    """Settings of a recording."""

    source: Drives | None = None


class Recording(Format):
    """recording.json."""

    robot: Robot
    sessions: list[dict[str, Any]]
    videos: list[str | None]
    markers: Markers
    board: Board
    camera: dict[str, Any] | None = None
    settings: RecordedWith | None = None
    commands: dict[str, Any] | None = None
    complete: bool | None = None
    stopped: Stopped | None = None


class Clock(Format):
    """The camera's clock against the robot's: s, and s per s."""

    flashes: list[float]
    drift: float
    sd: float | None = None
    drift_sd: float | None = None


class MarkerSeen(Format):
    """How a marker's colour was found."""

    colour: str | None = None
    sure: float | None = None
    doubt: str | None = None


class MarkersSeen(Format):
    """Those of a session."""

    front: MarkerSeen | None = None
    rear: MarkerSeen | None = None


class TrackedSession(Format):
    """A session that was tracked."""

    session: int
    clock: Clock | None = None
    markers: MarkersSeen | None = None


class Tracking(Format):
    """tracking.json."""

    sessions: list[TrackedSession]


class Place(Format):
    """A place on the robot, m: x ahead, y to the left of the middle of the axle."""

    x: Coordinate
    y: Coordinate


class Marker(Place):
    """A marker on the robot."""

    colour: str


class Markers(Format):
    """markers.json, and a recording's markers: lengths in m."""

    front: Marker
    rear: Marker
    lamp: Place | None = None
    height: Coordinate | None = None
    diameter: Annotated[float, Meta(gt=0, le=1000)] | None = None


class SessionClock(Clock, kw_only=True):
    """The clock of a session."""

    recording: str
    session: int


class MotorDelay(Format):
    """How late the motors answered in a session, s."""

    recording: str
    session: int
    delay: float
    sd: float
    lag: float
    corrected: bool


class SessionMarkers(MarkersSeen, kw_only=True):
    """The markers of a session."""

    recording: str
    session: int


class Sent(Format):
    """Counts of commands by what became of them."""

    sent: int
    cut: int
    completed: int


class SentOfDuration(Sent, kw_only=True, rename={"from_": "from"}):
    """Those of some durations, s; the name of ``from_`` has no underscore in the file."""

    from_: float
    to: float


class EqualReach(Format):
    """How far commands that were cut would have led."""

    ratio: float | None = None
    ratio_first: float | None = None


class Cutting(Format):
    """Which commands were cut."""

    by_class: dict[str, Sent]
    by_duration: list[SentOfDuration] | None = None
    equal_reach: EqualReach | None = None


class Dataset(Format):
    """dataset.json."""

    inputs: list[Column]
    outputs: list[Column]
    rows: int
    sources: list[Source]
    left_out: dict[str, int]
    within: Whole | None = None
    readings: Whole | None = None
    reasons: dict[str, str] | None = None
    warnings: list[str] | None = None
    windows: bool | None = None
    robots: list[Robot] | None = None
    virtual: bool | None = None
    clocks: list[SessionClock] | None = None
    motor_delays: list[MotorDelay] | None = None
    markers: list[SessionMarkers] | None = None
    cutting: Cutting | None = None
    perimeter: Perimeter | None = None
    settings: dict[str, Any] | None = None


class Calibration(Format):
    """calibration.json: lengths in m."""

    image_size: tuple[Pixels, Pixels]
    camera_matrix: Matrix
    distortion: tuple[float, float, float, float, float]
    rotation: Matrix | None = None
    translation: Triple | None = None
    rms_px: float | None = None
    photographs: int | None = None
    board_rms_m: float | None = None
    uncertainty: dict[str, Any] | None = None


# Simulators


class Training(Format):
    """How a simulator was trained."""

    held_out: float | None = None


class Generation(Format):
    """The errors of a generation, one for each output."""

    generation: float
    mse: list[float]


class Error(Format):
    """The errors of an output in the held-out rows."""

    mse: float
    mean_absolute_error: float


class Outputs(Format):
    """Something of each output."""

    dx: Error
    dy: Error
    dtheta: Error


class WallClock(Format):
    """How long it took, s."""

    training_seconds: float | None = None


class Share(Format):
    """How much the parts of a simulator count for an output."""

    product_units: float
    process: float


class Shares(Format):
    """Those of each output."""

    dx: Share
    dy: Share
    dtheta: Share


class Composition(Format):
    """The parts that a simulator was made of."""

    actuators: dict[str, dict[str, float]]
    delay: float
    product_units: Triple
    kernel_units: int
    shares: Shares


class SensorLearned(Format):
    """A sensor: m, and readings from 0 to 1."""

    name: str
    ahead: float
    aside: float
    after: float
    noise: float
    place_noise: float
    rms_error: float
    rms: float
    map: int


class ReadingsLearned(Format):
    """What sensors were learned from."""

    rows: int
    held_out: int
    sensors: list[SensorLearned]


class Simulator(Format):
    """simulator.json of any kind: where it is from, and how good it is."""

    kind: str
    inputs: list[Column] | None = None
    outputs: list[Column] | None = None
    training: Training | None = None
    history: list[Generation] | None = None
    test_errors: Outputs | None = None
    source: Source | list[Source] | None = None
    sources: list[Source] | None = None
    wall_clock: WallClock | None = None
    composition: Composition | None = None
    readings: ReadingsLearned | None = None
    robots: list[Robot] | None = None
    virtual: bool | None = None
    perimeter: Perimeter | None = None


class Swing(Format, forbid_unknown_fields=True):
    """Inputs that are computed of others; one that is not known would be of consequence."""

    swing: Annotated[float, Meta(gt=-1, le=1 - 1e-12)] | None = None


class Commands(Format):
    """The commands that a simulator learned from: ends of each."""

    commands: dict[str, tuple[float, float]]
    rows: Whole
    reach: float


class Mounted(Format):
    """The sensors of a motion network; the size of a cell of their maps, m."""

    names: list[str]
    cell: Annotated[float, Meta(gt=0, le=1000)]


class Corrections(Format, forbid_unknown_fields=True):
    """What adapted the motion to a robot."""

    forward: float
    turn: float
    yaw: float
    drift: float
    slip: float


class MotionNetwork(Simulator, kw_only=True):
    """simulator.json of a motion network."""

    kind: Literal["motion-network"]
    inputs: list[Column]
    network: dict[str, Any]
    coordinates: Literal["displacement", "residual-twist"]
    members: Annotated[int, Meta(ge=1, le=10**6)]
    derived: Swing | None = None
    drive: list[str] | None = None
    kernel_units: Annotated[int, Meta(ge=0, le=10**6)] | None = None
    central: bool | None = None
    noise: dict[str, Any] | None = None
    domain: Commands | None = None
    sensors: Mounted | None = None
    correction: Corrections | None = None


class SensorTables(Format):
    """Tables of readings by distance (m) and angle."""

    objects: list[str]
    first_distance: Size
    distance_step: Annotated[float, Meta(gt=0, le=10)]
    repeated: bool | None = None


class MotorTables(Format):
    """Tables of motion by speeds."""

    resolution: Amount
    repeated: bool | None = None


class TableNoise(Format):
    """Noise of sensors and motors."""

    kind: Literal["none", "uniform", "samples"]
    level: Amount


class Reaction(Format):
    """How late a robot answers, s."""

    hold: Delay
    answer: Delay
    lag: tuple[Delay, Delay]


class Arena(Format):
    """arena.json: walls x1, y1, x2, y2, obstacles x, y, radius, m."""

    outline: Walls
    obstacles: Annotated[
        list[tuple[Coordinate, Coordinate, Coordinate]], Meta(max_length=MOST_SHAPES)
    ]
    inner: Walls | None = None
    start: tuple[Coordinate, Coordinate, Coordinate] | None = None


class Tables(Simulator, kw_only=True):
    """simulator.json of tables."""

    kind: Literal["tables"]
    sensors: SensorTables
    motors: MotorTables
    radius: Annotated[float, Meta(ge=0.001, le=10)]
    noise: TableNoise
    arena: Arena
    reaction: Reaction | None = None


class SampledRobot(Robot):
    """The robot that sampled itself."""

    dialect: str | None = None
    baud: Annotated[int, Meta(ge=1, le=10**8)] | None = None
    full_speed: Annotated[int, Meta(ge=1, le=10**4)] | None = None


class SampleResult(Format):
    """What came of a sampling."""

    reaction: Reaction


class Sampling(Format):
    """sampling.json."""

    robot: SampledRobot
    virtual_lab: dict[str, Any] | None = None
    motors: Literal["counters", "camera"] | None = None
    options: dict[str, Any] | None = None
    result: SampleResult | None = None


class BegunSampling(Sampling, kw_only=True):
    """sampling.json of one that can be resumed."""

    settings: dict[str, Any]
    seed: int


# Controllers and what they did


class Unmet(Format):
    """Drives in arenas that a controller was not evolved in."""

    drives: Annotated[int, Meta(ge=1, le=10**9)]
    touched: Annotated[int, Meta(ge=0, le=10**9)]
    fitness: float
    vehicle: Annotated[int, Meta(ge=0, le=10**9)] | None = None


class Outcome(Format):
    """What is predicted of a controller, or came of a trial."""

    poses: list[FarPose | None] | None = None
    rest: FarPose | None = None
    fitness: float | None = None
    spread: float | None = None
    expected_fitness: float | None = None
    draws: float | None = None
    probability: Fraction | None = None
    completes: bool | None = None
    unsupported: float | None = None
    unmet: Unmet | None = None


class Prediction(Outcome):
    """An outcome of which every pose is known."""

    poses: list[FarPose] | None = None  # type: ignore[assignment]


class Run(Format):
    """The fitness of each generation."""

    best: list[float]
    mean: list[float]


class History(Format):
    """Of an evolution, and of the robust one after it; from generation ``transfer`` on, on the
    robot.
    """

    best: list[float] | None = None
    mean: list[float] | None = None
    robust_best: list[float] | None = None
    robust_mean: list[float] | None = None
    transfer: Annotated[int, Meta(ge=1)] | None = None


class RobotFitness(Format):
    """Fitness on the robot."""

    mean: float
    spread: float
    trials: int | None = None


class Pair(Format):
    """Where a controller drove in the simulator and on the robot."""

    simulated: list[FarPose]
    robot: list[FarPose]


class Evolution(Format):
    """How a controller was evolved."""

    settings: dict[str, Any] | None = None
    interrupted: bool | None = None
    history: History | None = None
    robot_fitness: RobotFitness | None = None
    trajectories: list[Pair] | None = None
    robot: Robot | None = None
    arena: Arena | None = None


class Controller(Format):
    """controller.json of any kind."""

    kind: str
    inputs: list[Column]
    task: Named
    predicted: Prediction
    simulator: Source
    evolution: Evolution
    start: FarPose | None = None
    settings: dict[str, Any] | None = None
    commands: list[CommandRow | None] | None = None


class Known(Format):
    """What was known as a command was given."""

    pose: FarPose
    after: FarPose
    rest: FarPose
    probability: Fraction
    generations: int
    seconds: float


class Foreseen(Format):
    """foreseen.json: what was known at each command of a plan that was replanned."""

    commands: list[Known]


class Start(Format):
    """Where a trial was to start, and where it did."""

    planned: FarPose | None = None
    actual: FarPose | None = None


class Actual(Outcome):
    """What came of a trial."""

    path: list[tuple[Far, Far, Far, Far]] | None = None
    cut: FarPose | None = None
    cut_error: TrialError | None = None
    reason: str | None = None
    seen_by: str | None = None


class TrialError(Format):
    """Distance (m) and difference of heading (rad) from the prediction."""

    position: float
    heading: float


class Deadlines(Format):
    """Steps that were late."""

    steps: int
    missed: int
    worst_late_s: float


class Guarded(Format):
    """Whether a guard ended drives where the trial was predicted, and where it was driven."""

    predicted: bool
    driven: bool


class Trial(Format):
    """trial.json."""

    virtual: bool
    controller: Source
    task: Named
    columns: list[CommandColumn]
    commands: list[CommandRow]
    predicted: Outcome
    actual: Actual
    errors: list[TrialError | None]
    kind: str | None = None
    simulator: dict[str, Any] | None = None
    plan_length: int | None = None
    start: Start | None = None
    ended_early: bool | None = None
    stopped: Stopped | None = None
    guard: Guarded | None = None
    deadlines: Deadlines | None = None


class TrialRecording(Format):
    """What is read of a recording by itself."""

    robot: Robot
    sessions: list[dict[str, Any]]
    complete: bool | None = None
    board: Board | None = None
    settings: dict[str, Any] | None = None


# Back to reality


class Adjusted(Format):
    """A parameter of the simulator."""

    name: str
    unit: str
    low: float
    high: float
    before: float


class Differences(Format):
    """How far a simulator's fitness is from reality's."""

    norm: float
    median: float
    rank: float | None = None
    poses: float | None = None


class Compared(Format):
    """Differences before and after an adaptation."""

    individuals: int
    before: Differences
    after: Differences


class Adaptation(Format):
    """What L3 did."""

    history: Run
    parameters: list[dict[str, float]]
    compared: Compared | None = None
    held_out: Compared | None = None
    left_out: Compared | None = None
    neighbours: Compared | None = None


class Cycle(Format):
    """A round of the alternation."""

    L1: Run | None = None
    L2: Run | None = None
    L3: Adaptation | None = None


class NamedGenes(Format):
    """The parameters of a controller by name."""

    named: dict[str, float] | None = None


class Trials(Format):
    """How many trials an evaluation has."""

    trials: int | None = None


class Best(Format):
    """A fitness in reality, and how many times that of the start it is."""

    fitness: float
    times_start: float | None = None


class BackToReality(Format):
    """back-to-reality.json."""

    controller: NamedGenes
    reality: dict[str, Any]
    settings: Trials
    parameters: list[Adjusted]
    start: Best
    best: Best
    trials: int
    real: list[float]
    believed: list[float]
    cycles: list[Cycle]


class TrialRow(Format):
    """A line of a file of trials."""

    genes: list[float]
    fitness: float
    poses: Annotated[list[Seen | None], Meta(min_length=1)] | None = None


class Genes(Format):
    """The genes of a controller, or its parameters by name."""

    genes: list[float] | None = None
    parameters: dict[str, float] | None = None


class Task(Format):
    """The file that ``--task`` takes."""

    name: str
    settings: dict[str, Any]


class Demo(Format):
    """demo.json: what a demo was begun with."""

    commands: int
    seed: int


class StageInput(Format):
    """A file or folder that a stage of a pipeline reads."""

    path: str
    sha256: str


class StageRow(Format):
    """A line of pipeline.jsonl: a stage that began, or that ended; then it has seconds."""

    stage: str
    key: str
    command: str
    options: dict[str, Any]
    inputs: dict[str, list[StageInput]]
    neurosim: str
    time: str
    out: str | None = None
    seconds: float | None = None
    sha256: str | None = None
    result: dict[str, Any] | None = None


class Kind(Format):
    """Of which kind a simulator is."""

    kind: str


class Checkpoint(Format):
    """What a search was begun with."""

    settings: dict[str, Any]
    options: dict[str, Any] | None = None


class Legged(Simulator, kw_only=True):
    """simulator.json of the walking robot."""

    parameters: dict[str, Any]
