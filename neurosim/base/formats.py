"""The JSON files of this program: every format, declared once.

A reader checks a file against one of these (:func:`neurosim.base.files.read_json`); a key with the
default None may be missing or null. Other keys are ignored.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from neurosim.base.declared import Coordinate, Fraction, Metres, MetresOrNone, Pose, TagId

#: Largest coordinates (m) and headings (rad) of results, because pictures of them are drawn.
FARTHEST = 1e5
Far = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]
FarPose = tuple[Far, Far, Far]
#: A number of rows or units, at least 0.
Whole = Annotated[int, Meta(ge=0, le=10**9)]
#: A size or an amount of noise, m or as a fraction.
Size = Annotated[float, Meta(ge=0, le=10)]
Amount = Annotated[float, Meta(ge=0, le=100)]
#: A delay of a robot, s.
Delay = Annotated[float, Meta(ge=0, le=1)]


class Format(Struct):
    """Base of all."""


#: Walls, corners and obstacles of places, m, and their largest number.
MOST_SHAPES = 1000
Corners = Annotated[list[tuple[Coordinate, Coordinate]], Meta(max_length=MOST_SHAPES)]
Walls = Annotated[
    list[tuple[Coordinate, Coordinate, Coordinate, Coordinate]], Meta(max_length=MOST_SHAPES)
]
#: A pose; null if the robot was not seen.
Seen = tuple[float | None, float | None, float | None]
#: A command: its numbers in the robot's units; in a plan, a duration in s follows.
CommandRow = Annotated[
    list[Annotated[float, Meta(ge=-1e6, le=1e6)]], Meta(min_length=2, max_length=64)
]
#: Sizes of a picture, and numbers of a camera.
Pixels = Annotated[int, Meta(ge=1, le=10**6)]
Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]


# Parts of several files


class Column(Format):
    """An input or output.

    Attributes:
        name: its name.
        unit: its unit.
    """

    name: str
    unit: str | None = None


class CommandColumn(Format):
    """A number of a command.

    Attributes:
        name: its name.
        unit: its unit.
    """

    name: str
    unit: str


class Robot(Format):
    """Which robot it was.

    Attributes:
        kind: name of its driver.
        virtual: whether it is the virtual lab's.
    """

    kind: str | None = None
    virtual: bool | None = None


class Source(Format):
    """The origin of something.

    Attributes:
        path: its file or folder.
        name: its name.
        dataset: name of the dataset.
        sha256: SHA-256 of its main file.
        virtual: whether it is from the virtual lab.
        perimeter: limits at which drives ended.
    """

    path: str | None = None
    name: str | None = None
    dataset: str | None = None
    sha256: str | None = None
    virtual: bool | None = None
    perimeter: Perimeter | None = None


class Board(Format):
    """Sides of a board, m.

    Attributes:
        length: side along x.
        width: side along y.
        line_inset: distance from the edge to the middle of the line.
        line_width: width of the line.
    """

    length: float
    width: float
    line_inset: MetresOrNone | None = None
    line_width: MetresOrNone | None = None


class Line(Format):
    """A line that is printed on the floor.

    Attributes:
        points: points of its middle, m.
        width: width of the line, m.
        closed: whether the last point is joined to the first.
    """

    points: Annotated[list[tuple[Coordinate, Coordinate]], Meta(max_length=100_000)]
    width: Metres | None = None
    closed: bool | None = None


class Place(Format):
    """A place; lengths in m.

    Attributes:
        outline: corners of the walls around it.
        walls: walls that stand inside: x1, y1, x2, y2 of their middles.
        obstacles: round obstacles: x, y, radius.
        lines: lines on the floor.
        lights: lights: x, y.
        board: the board on the floor.
        start: pose at which robots start.
    """

    outline: Corners | None = None
    walls: Walls | None = None
    obstacles: (
        Annotated[list[tuple[Coordinate, Coordinate, Metres]], Meta(max_length=MOST_SHAPES)] | None
    ) = None
    lines: Annotated[list[Line], Meta(max_length=100)] | None = None
    lights: Corners | None = None
    board: Board | None = None
    start: Pose | None = None


class Perimeter(Format):
    """The limits at which a guard ends drives.

    Attributes:
        board: the board.
        sensors: places of the light sensors on the robot, m.
        margin: distance inside the edge, m.
    """

    board: Board
    sensors: Annotated[list[tuple[Coordinate, Coordinate]], Meta(max_length=100)]
    margin: MetresOrNone | None = None


class Stopped(Format):
    """The reason why the guard stopped the robot.

    Attributes:
        code: 1 a line, 2 the edge, 3 the robot was not seen.
        time: time on the robot's clock, s.
        command: number of the command, from 0.
        into: time since the start of the command, s.
        sensor: the light sensor that met the line.
        pose: pose of the robot.
        unseen_since: time of the last sighting, s.
    """

    code: Annotated[int, Meta(ge=1, le=3)]
    time: float
    command: int | None = None
    into: float = 0.0
    sensor: str | None = None
    pose: FarPose | None = None
    unseen_since: float | None = None


class Named(Format):
    """A task by its name.

    Attributes:
        name: name of the task.
        settings: settings of the task.
    """

    name: str
    settings: dict[str, Any] | None = None


# Recordings and datasets


class Drives(Format):
    """The source of a recording's commands.

    Attributes:
        controller: the controller that drove.
    """

    controller: dict[str, Any] | None = None


class RecordedWith(Format):
    """Settings of a recording.

    Attributes:
        source: source of the commands.
    """

    source: Drives | None = None


class Recording(Format):
    """A drive that was recorded.

    Attributes:
        robot: the robot, as its driver describes it.
        sessions: sessions, one for each time the robot was started.
        videos: file of each session; null without a camera.
        markers: markers on the robot.
        board: board under the robot.
        place: the place around the robot.
        camera: the camera.
        settings: settings of the recording.
        commands: names, units and limits of a command's numbers.
        complete: whether it came to its end.
        stopped: reason why the guard ended the drive, if it did.
    """

    robot: Robot
    sessions: list[dict[str, Any]]
    videos: list[str | None]
    markers: Markers
    board: Board
    place: Place | None = None
    camera: dict[str, Any] | None = None
    settings: RecordedWith | None = None
    commands: dict[str, Any] | None = None
    complete: bool | None = None
    stopped: Stopped | None = None


class Clock(Format):
    """The camera's clock, relative to the robot's.

    Attributes:
        flashes: times of the lamp's flashes.
        drift: drift of the camera's clock, s per s.
        sd: standard deviation of the offset, s.
        drift_sd: standard deviation of the drift.
    """

    flashes: list[float]
    drift: float
    sd: float | None = None
    drift_sd: float | None = None


class MarkerSeen(Format):
    """How a marker's colour was found.

    Attributes:
        colour: colour, as #rrggbb or by name.
        confidence: how certain the colour is, 0 to 1.
        reason: the reason of a low confidence.
    """

    colour: str | None = None
    confidence: float | None = None
    reason: str | None = None


class TagSeen(Format):
    """A tag that was tracked.

    Attributes:
        dictionary: dictionary of the tag, by OpenCV's name without ``DICT_``.
        id: its number in the dictionary.
        others: numbers of other tags that were seen.
    """

    dictionary: str
    id: int
    others: list[int] | None = None


class MarkersSeen(Format):
    """The markers of a session.

    Attributes:
        front: front marker.
        rear: rear marker.
        tag: the tag.
    """

    front: MarkerSeen | None = None
    rear: MarkerSeen | None = None
    tag: TagSeen | None = None


class TrackedSession(Format):
    """A session that was tracked.

    Attributes:
        session: its number, from 1.
        clock: clock of the camera.
        markers: colours of the markers.
    """

    session: int
    clock: Clock | None = None
    markers: MarkersSeen | None = None


class Tracking(Format):
    """The result of tracking a recording.

    Attributes:
        sessions: sessions of the recording.
    """

    sessions: list[TrackedSession]


class Spot(Format):
    """A place on the robot, m: x ahead, y to the left of the middle of the axle.

    Attributes:
        x: distance forward.
        y: distance to the left.
    """

    x: Coordinate
    y: Coordinate


class Marker(Spot):
    """A marker on the robot; of a tag, the middle of its upper or of its lower edge.

    Attributes:
        colour: colour, by name or as #rrggbb; none for the edge of a tag.
    """

    colour: str | None = None


class TagName(Format):
    """A tag, of the kinds that OpenCV knows.

    Attributes:
        dictionary: dictionary of the tag, by OpenCV's name without ``DICT_``.
        id: its number in the dictionary.
    """

    dictionary: str
    id: TagId


class Markers(Format):
    """The markers on a robot: two colours, or a tag.

    Attributes:
        front: front marker, or upper edge of the tag.
        rear: rear marker, or lower edge of the tag.
        tag: the tag; none where there are two colours.
        lamp: place of the lamp.
        height: height of the markers above the board.
        diameter: diameter of a marker.
    """

    front: Marker
    rear: Marker
    tag: TagName | None = None
    lamp: Spot | None = None
    height: Coordinate | None = None
    diameter: Annotated[float, Meta(gt=0, le=1000)] | None = None


class SessionClock(Clock, kw_only=True):
    """The clock of a session.

    Attributes:
        recording: name of the recording.
        session: its number, from 1.
    """

    recording: str
    session: int


class MotorDelay(Format):
    """The delay of the motors in a session, s.

    Attributes:
        recording: name of the recording.
        session: its number, from 1.
        delay: delay from a command to its effect.
        sd: standard deviation of the delay.
        lag: time constant of the motors.
        corrected: whether the rows are corrected for the delay.
    """

    recording: str
    session: int
    delay: float
    sd: float
    lag: float
    corrected: bool


class SessionMarkers(MarkersSeen, kw_only=True):
    """The markers of a session.

    Attributes:
        recording: name of the recording.
        session: its number, from 1.
    """

    recording: str
    session: int


class Sent(Format):
    """Counts of commands.

    Attributes:
        sent: all commands.
        cut: commands that were stopped early.
        completed: commands that were not stopped.
    """

    sent: int
    cut: int
    completed: int


class SentOfDuration(Sent, kw_only=True, rename={"from_": "from"}):
    """Counts of the commands with a range of durations, s.

    Attributes:
        from_: shortest duration.
        to: longest duration.
    """

    from_: float
    to: float


class EqualReach(Format):
    """Distances of the commands with equal speeds, relative to those that were chosen.

    Attributes:
        ratio: ratio of all completed commands; 1 if cutting has no effect.
        ratio_first: ratio without the commands that were sent again.
    """

    ratio: float | None = None
    ratio_first: float | None = None


class Cutting(Format):
    """Counts of commands that were cut at a line or an edge.

    Attributes:
        by_class: counts of random commands, of commands with equal speeds, and of stops.
        by_duration: counts by planned duration.
        equal_reach: effect on the distances.
    """

    by_class: dict[str, Sent]
    by_duration: list[SentOfDuration] | None = None
    equal_reach: EqualReach | None = None


class Dataset(Format):
    """Rows of commands and displacements.

    Attributes:
        inputs: columns of a command.
        outputs: columns of a displacement.
        rows: number of rows.
        sources: recordings or files.
        left_out: number of commands without a row, by reason.
        within: number of rows of within.csv.
        readings: number of rows of readings.csv.
        reasons: explanation of each reason.
        warnings: warnings about columns that look wrong.
        windows: whether each row begins where the row before ended.
        starts: whether each row says where the robot began.
        robots: robots of the recordings.
        virtual: whether it is from the virtual lab.
        clocks: clocks of the sessions.
        motor_delays: delays of the motors in the sessions.
        markers: markers of the sessions.
        cutting: counts of commands that were cut.
        perimeter: limits at which drives ended.
        settings: settings of the import.
    """

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
    starts: bool | None = None
    robots: list[Robot] | None = None
    virtual: bool | None = None
    clocks: list[SessionClock] | None = None
    motor_delays: list[MotorDelay] | None = None
    markers: list[SessionMarkers] | None = None
    cutting: Cutting | None = None
    perimeter: Perimeter | None = None
    settings: dict[str, Any] | None = None


class Calibration(Format):
    """A camera: its lens, and its pose above the board.

    Attributes:
        image_size: width and height.
        camera_matrix: camera matrix of the lens, pixels.
        distortion: coefficients k1, k2, p1, p2, k3 of the lens.
        rotation: rotation from the board's frame to the camera's.
        translation: translation from the board's frame to the camera's, m.
        rms_px: error at the chessboard's corners, pixels.
        photographs: number of photographs that were used.
        board_rms_m: error at the points on the board, m.
        uncertainty: standard deviations of the lens and of positions.
    """

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
    """How a simulator was trained.

    Attributes:
        held_out: fraction of the rows that was held out.
    """

    held_out: float | None = None


class Generation(Format):
    """The errors of a generation, one for each output.

    Attributes:
        generation: its number.
        mse: mean squared errors.
    """

    generation: float
    mse: list[float]


class Error(Format):
    """The errors of an output in the held-out rows.

    Attributes:
        mse: mean squared error.
        mean_absolute_error: mean absolute error.
    """

    mse: float
    mean_absolute_error: float


class Outputs(Format):
    """A value for each output.

    Attributes:
        dx: errors forward, cm.
        dy: errors to the left, cm.
        dtheta: errors of the turn, degrees.
    """

    dx: Error
    dy: Error
    dtheta: Error


class WallClock(Format):
    """Durations, s.

    Attributes:
        training_seconds: duration of the training.
    """

    training_seconds: float | None = None


class Fractions(Format):
    """Weights of a part of the simulator in each output, 0 to 1.

    Attributes:
        dx: weight forward.
        dy: weight to the left.
        dtheta: weight in the turn.
    """

    dx: float
    dy: float
    dtheta: float


class Floor(Format):
    """A map of the slip over the board.

    Attributes:
        length: distance over which slip changes, m.
        ahead: effect of slip on the distance driven, relative to its effect on turns.
    """

    length: Annotated[float, Meta(gt=0)]
    ahead: Annotated[float, Meta(ge=0, le=1)]


class Unevenness(Floor):
    """A learned map of the slip.

    Attributes:
        sd: standard deviation of the slip over the board, as a fraction of the motion.
    """

    sd: float


class Composition(Format):
    """The parts of a simulator.

    Attributes:
        actuators: laws and dead band of each actuator; the laws may be those of the body's modes,
            such as ``+0.50 left +0.50 right``.
        delay: delay of all actuators, s.
        kernel_units: number of units of the Gaussian process.
        process: weights of the Gaussian process.
        floor: the floor, where the rows tell of it.
        drift: lags of what products of speeds and losses in curves add to the velocity ahead and
            aside, s; 0: none.
    """

    actuators: dict[str, dict[str, float]]
    delay: float
    kernel_units: int
    process: Fractions
    floor: Unevenness | None = None
    drift: tuple[float, float] = (0.0, 0.0)


class SensorLearned(Format):
    """A sensor: m, and readings from 0 to 1.

    Attributes:
        name: its name.
        ahead: distance forward of the middle of the axle.
        aside: distance to the left of it.
        after: delay, s.
        noise: standard deviation of a reading.
        place_noise: standard deviation of its place.
        rms_error: root mean square error on held-out readings.
        rms: standard deviation of these readings.
        map: number of its map.
        flat: whether it saw nothing: its readings are all the same.
    """

    name: str
    ahead: float
    aside: float
    after: float
    noise: float
    place_noise: float
    rms_error: float
    rms: float
    map: int
    flat: bool


class ReadingsLearned(Format):
    """The data from which sensors were learned.

    Attributes:
        rows: number of readings.
        held_out: number of readings that were held out.
        sensors: each sensor.
    """

    rows: int
    held_out: int
    sensors: list[SensorLearned]


class Simulator(Format):
    """Any simulator: its origin and its quality.

    Attributes:
        kind: name of the kind, motion-network, tables, legged or a registered one.
        inputs: columns of a command.
        outputs: columns of a displacement.
        training: settings of the training.
        history: errors during training.
        test_errors: errors on the held-out rows.
        source: its dataset, or its samples.
        sources: recordings of the dataset.
        wall_clock: duration of the training.
        composition: parts of the simulator.
        readings: data from which its sensors were learned.
        robots: robots of the data.
        virtual: whether it is from the virtual lab.
        perimeter: limits at which drives end.
    """

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
    """Inputs that are computed from others.

    Attributes:
        swing: phase of the input for a change of direction.
    """

    swing: Annotated[float, Meta(gt=-1, le=1 - 1e-12)] | None = None


class Commands(Format):
    """The commands from which a simulator learned.

    Attributes:
        commands: lowest and highest value of each number.
        rows: number of rows.
        reach: distance at which a command counts as like a row's.
    """

    commands: dict[str, tuple[float, float]]
    rows: Whole
    reach: float


class Mounted(Format):
    """The sensors of a motion network.

    Attributes:
        names: names of the sensors.
        cell: distance between points of their maps, m.
    """

    names: list[str]
    cell: Annotated[float, Meta(gt=0, le=1000)]


class Corrections(Format, forbid_unknown_fields=True):
    """A correction of the motion, adapted to a robot.

    Attributes:
        forward: factor of the distance forward.
        turn: factor of the turn.
        yaw: additional left turn, rad/m.
        drift: additional distance forward, m/rad.
        slip: slip to the left, s.
    """

    forward: float
    turn: float
    yaw: float
    drift: float
    slip: float


class MotionNetwork(Simulator, kw_only=True):
    """A simulator that was learned from a dataset.

    Attributes:
        kind: its kind.
        inputs: columns of a command.
        network: shape of the networks.
        coordinates: outputs of the networks: the displacement, or the deviation from the drive
            model's twist.
        members: number of ensemble members.
        derived: computed inputs.
        drive: names of the drive model's laws.
        kernel_units: number of units of the Gaussian process.
        central: whether a network of the mean precedes the members.
        noise: kind of the noise model.
        excess: whether a measured speed counts.
        domain: commands from which it learned.
        sensors: sensors that it predicts.
        floor: the floor that it knows.
        correction: correction of the motion, adapted to a robot.
    """

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
    excess: bool | None = None
    domain: Commands | None = None
    sensors: Mounted | None = None
    floor: Floor | None = None
    correction: Corrections | None = None


class SensorTables(Format):
    """Tables of readings by distance (m) and angle.

    Attributes:
        objects: kinds of objects in front of the sensors, such as wall, cylinder and
            cylinder-12.5mm; or light.
        first_distance: first distance of the tables, m.
        distance_step: difference of two distances, m.
        repeated: whether samples were repeated.
    """

    objects: list[str]
    first_distance: Size
    distance_step: Annotated[float, Meta(gt=0, le=10)]
    repeated: bool | None = None


class MotorTables(Format):
    """Tables of motion by speeds.

    Attributes:
        resolution: difference of two speeds, %.
        repeated: whether samples were repeated.
    """

    resolution: Amount
    repeated: bool | None = None


class TableNoise(Format):
    """Noise of sensors and motors.

    Attributes:
        kind: kind of noise, none, uniform, or that of repeated samples.
        level: level of uniform noise, as a fraction.
    """

    kind: Literal["none", "uniform", "samples"]
    level: Amount


class Reaction(Format):
    """How late a robot answers, s.

    Attributes:
        hold: delay from a reading to its command.
        answer: delay from a command to its effect.
        lag: time constants of the left and the right wheel.
    """

    hold: Delay
    answer: Delay
    lag: tuple[Delay, Delay]


class Tables(Simulator, kw_only=True):
    """A simulator of look-up tables.

    Attributes:
        kind: its kind.
        sensors: tables of readings of proximity.
        lights: table of readings of ambient light.
        motors: tables of motion.
        radius: radius of the robot, m.
        noise: noise of sensors and motors.
        place: the place around the robot.
        reaction: delays of the robot.
    """

    kind: Literal["tables"]
    sensors: SensorTables
    motors: MotorTables
    radius: Annotated[float, Meta(ge=0.001, le=10)]
    noise: TableNoise
    place: Place
    lights: SensorTables | None = None
    reaction: Reaction | None = None


class SampledRobot(Robot):
    """The robot that sampled itself.

    Attributes:
        dialect: dialect of its protocol.
        baud: bits per second of the serial line.
        full_speed: the robot's number for 100 %.
        radius: radius of its body.
    """

    dialect: str | None = None
    baud: Annotated[int, Meta(ge=1, le=10**8)] | None = None
    full_speed: Annotated[int, Meta(ge=1, le=10**6)] | None = None
    radius: Annotated[float, Meta(ge=0.001, le=10)] | None = None


class SampleResult(Format):
    """The result of a sampling.

    Attributes:
        reaction: delays of the robot.
    """

    reaction: Reaction


class Sampling(Format):
    """A sampling: a robot that samples its sensors and motors.

    Attributes:
        robot: robot that sampled itself.
        virtual_lab: the virtual robot.
        motors: source of the motion.
        options: options for --resume.
        result: result at its end.
    """

    robot: SampledRobot
    virtual_lab: dict[str, Any] | None = None
    motors: Literal["counters", "camera"] | None = None
    options: dict[str, Any] | None = None
    result: SampleResult | None = None


class BegunSampling(Sampling, kw_only=True):
    """A sampling that can be resumed.

    Attributes:
        settings: settings of the sampling.
        seed: random seed.
    """

    settings: dict[str, Any]
    seed: int


# Controllers and their drives


class Unmet(Format):
    """Drives in arenas that a controller was not evolved in.

    Attributes:
        drives: number of drives.
        touched: drives in which the robot touched something.
        fitness: mean fitness until the robot came near something.
        vehicle: drives in which a hand-written controller touched something.
    """

    drives: Annotated[int, Meta(ge=1, le=10**9)]
    touched: Annotated[int, Meta(ge=0, le=10**9)]
    fitness: float
    vehicle: Annotated[int, Meta(ge=0, le=10**9)] | None = None


class Outcome(Format):
    """The prediction or the result of a drive.

    Attributes:
        poses: poses at the boundaries of commands; null if not seen.
        rest: last pose.
        fitness: fitness of the drive.
        spread: standard deviation of the fitness over samples.
        expected_fitness: mean fitness over samples.
        draws: number of samples.
        probability: probability of success.
        completes: whether the task is done.
        unsupported: fraction of the time in commands unlike any in the simulator's data.
        unmet: drives in new arenas.
    """

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
    """A prediction in which every pose is known.

    Attributes:
        poses: poses at the boundaries of commands.
    """

    poses: list[FarPose] | None = None  # type: ignore[assignment]


class Run(Format):
    """The fitness of each generation.

    Attributes:
        best: best fitness.
        mean: mean fitness.
    """

    best: list[float]
    mean: list[float]


class History(Format):
    """Fitness of an evolution, of the robust one after it, and on the robot.

    Attributes:
        best: best fitness of each generation.
        mean: mean fitness of each generation.
        robust_best: best of each robust generation.
        robust_mean: mean of each robust generation.
        transfer: number of the generation from which on the robot drives.
    """

    best: list[float] | None = None
    mean: list[float] | None = None
    robust_best: list[float] | None = None
    robust_mean: list[float] | None = None
    transfer: Annotated[int, Meta(ge=1)] | None = None


class RobotFitness(Format):
    """Fitness on the robot.

    Attributes:
        mean: mean over the trials.
        spread: standard deviation over the trials.
        trials: number of trials.
    """

    mean: float
    spread: float
    trials: int | None = None


class Pair(Format):
    """Paths of a controller in the simulator and on the robot.

    Attributes:
        simulated: path in the simulator.
        robot: path on the robot.
    """

    simulated: list[FarPose]
    robot: list[FarPose]


class Evolution(Format):
    """How a controller was evolved.

    Attributes:
        settings: settings of the search.
        interrupted: whether it was interrupted.
        history: fitness of each generation.
        robot_fitness: fitness of the controller on the robot.
        trajectories: paths of the controller.
        robot: robot of the trials.
        place: the place around the robot.
    """

    settings: dict[str, Any] | None = None
    interrupted: bool | None = None
    history: History | None = None
    robot_fitness: RobotFitness | None = None
    trajectories: list[Pair] | None = None
    robot: Robot | None = None
    place: Place | None = None


class Controller(Format):
    """A controller of any kind.

    Attributes:
        kind: name of the kind, plan, network, recurrent, gait or a registered one.
        inputs: observations; of a plan, columns of a command.
        task: its task.
        predicted: its drive in the simulator.
        simulator: simulator in which it evolved.
        evolution: settings and history of its evolution.
        start: pose of the robot.
        settings: settings of the kind.
        commands: commands of a plan; null for one that is not given.
    """

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
    """The prediction of a command at the time when it was sent.

    Attributes:
        pose: pose at the start of the command.
        after: pose at its end.
        rest: pose at the end of the plan.
        probability: probability of success.
        generations: generations of the search.
        seconds: duration of the search.
    """

    pose: FarPose
    after: FarPose
    rest: FarPose
    probability: Fraction
    generations: int
    seconds: float


class Foreseen(Format):
    """The predictions of a replanned plan, one for each command.

    Attributes:
        commands: predictions, one for each command.
    """

    commands: list[Known]


class Start(Format):
    """The start of a trial.

    Attributes:
        planned: the pose of the controller.
        actual: the tracked pose.
    """

    planned: FarPose | None = None
    actual: FarPose | None = None


class Actual(Outcome):
    """The result of a trial.

    Attributes:
        path: path: time (s), x, y and heading.
        cut: pose at which the guard ended the drive.
        cut_error: error of the prediction there.
        reason: reason why the task was not done.
        seen_by: source of the poses: camera, counters, or null.
    """

    path: list[tuple[Far, Far, Far, Far]] | None = None
    cut: FarPose | None = None
    cut_error: TrialError | None = None
    reason: str | None = None
    seen_by: str | None = None


class TrialError(Format):
    """Distance (m) and difference of heading (rad) from the prediction.

    Attributes:
        position: distance.
        heading: difference.
    """

    position: float
    heading: float


class Deadlines(Format):
    """Late steps of a closed-loop drive.

    Attributes:
        steps: number of steps.
        missed: number of steps later than a tenth of their duration.
        worst_late_s: greatest delay, s.
    """

    steps: int
    missed: int
    worst_late_s: float


class Guarded(Format):
    """Whether a guard ended drives.

    Attributes:
        predicted: whether it did in the prediction.
        driven: whether it did on the robot.
    """

    predicted: bool
    driven: bool


class Trial(Format):
    """A drive of a controller on a robot, next to its prediction.

    Attributes:
        virtual: whether it is from the virtual lab.
        controller: controller that drove.
        task: its task.
        columns: numbers of a command.
        commands: commands that were sent.
        predicted: prediction.
        actual: result.
        errors: errors after each command of a plan.
        kind: kind of the controller.
        simulator: simulator of the prediction.
        plan_length: number of commands in the plan.
        start: start of the drive.
        ended_early: whether commands are missing.
        stopped: reason why the guard ended the drive, if it did.
        guard: whether a guard ends drives.
        deadlines: late steps of a closed-loop controller.
    """

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
    """The keys of a recording that a report reads.

    Attributes:
        robot: the robot.
        sessions: sessions of the recording.
        complete: whether it came to its end.
        board: board under the robot.
        settings: settings of the recording.
    """

    robot: Robot
    sessions: list[dict[str, Any]]
    complete: bool | None = None
    board: Board | None = None
    settings: dict[str, Any] | None = None


# Back to reality


class Adjusted(Format):
    """A parameter of the simulator.

    Attributes:
        name: its name.
        unit: its unit.
        low: least value.
        high: greatest value.
        before: value before the run.
    """

    name: str
    unit: str
    low: float
    high: float
    before: float


class Differences(Format):
    """Differences between the fitness in the simulator and in reality.

    Attributes:
        norm: Euclidean norm.
        median: median, without sign.
        rank: Spearman's rank correlation.
        poses: root mean square distance of poses, m.
    """

    norm: float
    median: float
    rank: float | None = None
    poses: float | None = None


class Compared(Format):
    """Differences before and after an adaptation.

    Attributes:
        individuals: number of controllers.
        before: differences before the adaptation.
        after: differences after it.
    """

    individuals: int
    before: Differences
    after: Differences


class Adaptation(Format):
    """The result of L3.

    Attributes:
        history: fitness during the search.
        parameters: values of each parameter set.
        compared: differences for the controllers that L3 used.
        held_out: differences for trials that were held out.
        left_out: differences for trials that L3 did not use.
        neighbours: differences for the controllers of L2.
    """

    history: Run
    parameters: list[dict[str, float]]
    compared: Compared | None = None
    held_out: Compared | None = None
    left_out: Compared | None = None
    neighbours: Compared | None = None


class Cycle(Format):
    """A round of the alternation.

    Attributes:
        L1: evolution in the simulator.
        L2: learning in reality.
        L3: adaptation of the simulator.
    """

    L1: Run | None = None
    L2: Run | None = None
    L3: Adaptation | None = None


class NamedGenes(Format):
    """The parameters of a controller by name.

    Attributes:
        named: values by name.
    """

    named: dict[str, float] | None = None


class Trials(Format):
    """The number of trials of an evaluation.

    Attributes:
        trials: number of trials.
    """

    trials: int | None = None


class Best(Format):
    """A fitness in reality.

    Attributes:
        fitness: mean fitness.
        times_start: fitness relative to the start's.
    """

    fitness: float
    times_start: float | None = None


class BackToReality(Format):
    """A run of back to reality.

    Attributes:
        controller: the best controller.
        reality: reality of the trials.
        settings: settings of the run.
        parameters: parameters of the simulator that L3 can change.
        start: the first controller.
        best: the best controller.
        trials: number of trials in reality.
        real: fitness of each evaluation in reality.
        believed: fitness of the best confirmed controller after each evaluation.
        cycles: results of L1, L2 and L3 in each cycle.
    """

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
    """A trial in reality.

    Attributes:
        genes: genes of the controller.
        fitness: fitness in reality.
        poses: poses of the robot, if it was tracked.
    """

    genes: list[float]
    fitness: float
    poses: Annotated[list[Seen | None], Meta(min_length=1)] | None = None


class Genes(Format):
    """The genes of a controller, or its parameters by name.

    Attributes:
        genes: all genes, in order.
        parameters: values by name.
    """

    genes: list[float] | None = None
    parameters: dict[str, float] | None = None


class Task(Format):
    """A task, as ``--task`` takes it.

    Attributes:
        name: name of the task.
        settings: settings of the task.
    """

    name: str
    settings: dict[str, Any]


class Demo(Format):
    """The options of a demo.

    Attributes:
        commands: number of recorded commands.
        seed: random seed.
    """

    commands: int
    seed: int


class StageInput(Format):
    """A file or folder that a stage of a pipeline reads.

    Attributes:
        path: its path.
        sha256: SHA-256 of its content.
    """

    path: str
    sha256: str


class StageRow(Format):
    """The start of a stage of a pipeline, or its end; the end has ``seconds``.

    Attributes:
        stage: name of the stage.
        key: hash of everything that the result depends on.
        command: command of neurosim.
        options: options of the command.
        inputs: files and folders that it reads.
        neurosim: version of neurosim.
        time: time of the line.
        out: its folder.
        seconds: duration.
        sha256: SHA-256 of the result.
        result: result, as --json prints it.
    """

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
    """The kind of a simulator.

    Attributes:
        kind: name of the kind, motion-network, tables, legged or a registered one.
    """

    kind: str


class Checkpoint(Format):
    """The start of a search that can be resumed.

    Attributes:
        settings: settings of the search.
        options: options for --resume.
    """

    settings: dict[str, Any]
    options: dict[str, Any] | None = None


class Legged(Simulator, kw_only=True):
    """The simulator of a legged robot.

    Attributes:
        robot: which robot it is.
        parameters: parameters of the robot and of the floor.
    """

    robot: Literal["walker", "walker-with-servos", "quadratot"] = "walker"
    parameters: dict[str, Any]
