import math

import numpy as np
import pytest
import tracking_scene as scene

from tracking.camera.video import Video
from tracking.markers.colours import parse_colour
from tracking.markers.pair import Geometry
from tracking.markers.pointing import colour_at
from tracking.markers.tracker import Tracker

SIZE = (320, 240)
FPS = 30.0
BACKGROUND = scene.background(SIZE)


def new_tracker(geometry=None, colours=("pink", "blue")):
    return Tracker(*(parse_colour(colour) for colour in colours), geometry)


def drive(frames=60, seed=0):
    """Middle and heading of a robot that speeds up, turns both ways and stops."""
    rng = np.random.default_rng(seed)
    start, heading = np.array([110.0, 120.0]), rng.uniform(-3, 3)
    for i in range(frames):
        speed = 2.0 * math.sin(math.pi * i / 20) ** 2
        heading += 0.09 * math.sin(2 * math.pi * i / 45)
        start = start + speed * np.array([math.cos(heading), -math.sin(heading)])
        yield start, heading


def picture(middle, heading, rng, paint=None, **robot):
    image = BACKGROUND.copy()
    centres = scene.robot(image, middle, heading, body=(48, 18), **robot)
    if paint is not None:
        paint(image, centres)
    return scene.finish(image, rng, jpeg=92), np.stack(centres)


def pixels_of(sighting):
    return np.stack([sighting.front, sighting.rear])


@pytest.mark.slow
@pytest.mark.parametrize("fade", [True, False])
def test_every_frame_to_a_tenth_of_a_pixel(fade):
    rng, tracker, misses = np.random.default_rng(0), new_tracker(), []
    for i, (middle, heading) in enumerate(drive()):
        frame, truth = picture(middle, heading, rng, fade=fade)
        sighting = tracker.update(frame, i / FPS)
        assert sighting.quality > 0.5
        misses.append(pixels_of(sighting) - truth)
    assert np.abs(np.mean(misses, axis=0)).max() < 0.03
    assert np.std(misses, axis=0).max() < 0.06
    assert np.abs(misses).max() < 0.15


def test_what_is_learned_is_close_to_the_paint():
    tracker = new_tracker()
    tracker.update(picture((160.0, 120.0), 0.3, np.random.default_rng(0))[0], 0.0)
    for look, (blue, green, red) in zip(tracker.looks, (scene.PINK, scene.BLUE), strict=True):
        hue = math.atan2(math.sqrt(0.75) * (green - blue), red - (green + blue) / 2)
        assert math.atan2(look.direction[1], look.direction[0]) == pytest.approx(hue, abs=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("covered", [0, 1])
@pytest.mark.parametrize("fraction", [0.5, 1.0])
def test_a_covered_marker_has_no_pose(covered, fraction):
    rng, tracker = np.random.default_rng(1), new_tracker()

    def cover(image, centres):
        where = centres[covered] + np.array([-14.0 * (1 - fraction), 0.0])
        scene.paint_rectangle(image, where, (7.5, 9.0), 0.0, (150, 160, 165))

    for i, (middle, heading) in enumerate(drive()):
        hidden = 20 <= i < 40
        frame, truth = picture(middle, heading, rng, cover if hidden else None)
        sighting = tracker.update(frame, i / FPS)
        if hidden and fraction == 1.0:
            assert not sighting.in_view
            assert np.isnan(sighting.front).all()
            assert sighting.quality == 0
            assert math.isnan(sighting.lamp)
        elif sighting.in_view:
            # Half a marker may be detected correctly or not at all, but never at a wrong position.
            assert np.abs(pixels_of(sighting) - truth).max() < 1.0
        if not hidden:
            assert sighting.in_view


@pytest.mark.slow
def test_things_of_the_same_colours_capture_nothing():
    rng, tracker = np.random.default_rng(2), new_tracker()

    def others(image, centres):
        # Another robot, a ball, and a single marker that could be mistaken for the robot's.
        scene.robot(image, (50.0, 40.0), 1.0, separation=50, body=(64, 18))
        scene.paint_disc(image, (280.0, 60.0), 9.0, scene.PINK, fade=False)
        scene.paint_disc(image, centres[0] + (0.0, 17.0), 6.4, scene.PINK)
        scene.paint_disc(image, centres[1] + (16.0, 0.0), 6.4, scene.BLUE)

    result = 0
    for i, (middle, heading) in enumerate(drive()):
        frame, truth = picture(middle, heading, rng, others if i >= 10 else None)
        sighting = tracker.update(frame, i / FPS)
        if sighting.in_view:
            result += 1
            assert np.abs(pixels_of(sighting) - truth).max() < 2.0
        else:
            assert i >= 10
    assert result > 50


@pytest.mark.slow
def test_a_hidden_marker_is_not_replaced_by_another_of_its_colour():
    rng, tracker = np.random.default_rng(3), new_tracker()

    def away(image, centres):
        scene.paint_disc(image, (260.0, 200.0), 6.4, scene.BLUE)

    for i, (middle, heading) in enumerate(drive()):
        hidden = i >= 20
        rear = None if hidden else scene.BLUE
        frame, _ = picture(middle, heading, rng, away, rear=rear)
        assert tracker.update(frame, i / FPS).in_view != hidden


@pytest.mark.slow
def test_found_again_wherever_a_hand_put_it_and_never_swapped():
    rng, tracker = np.random.default_rng(4), new_tracker()
    for i in range(12):
        frame, _ = picture((90.0, 80.0), 0.2, rng)
        tracker.update(frame, i / FPS)
    for i in range(12, 90):
        tracker.update(scene.finish(BACKGROUND.copy(), rng), i / FPS)
    results = []
    for i in range(90, 110):
        frame, truth = picture((220.0, 160.0), 0.2 + math.pi, rng)
        sighting = tracker.update(frame, i / FPS)
        if sighting.in_view:
            results.append(pixels_of(sighting) - truth)
    assert len(results) >= 15
    assert np.abs(results).max() < 0.15


def test_geometry_tells_the_robot_from_a_larger_pair():
    rng = np.random.default_rng(5)

    def larger(image, centres):
        scene.robot(image, (240.0, 60.0), 0.7, separation=44, radius=8.0, body=(62, 22))

    frame, truth = picture((100.0, 150.0), 2.0, rng, larger)
    scale = 200.0  # pixels a metre
    geometry = Geometry(lambda pixels: pixels / scale, 34 / scale, 12.8 / scale)
    sighting = new_tracker(geometry).update(frame, 0.0)
    assert np.abs(pixels_of(sighting) - truth).max() < 0.15
    missing = Geometry(lambda pixels: pixels / scale, 80 / scale, 12.8 / scale)
    assert not new_tracker(missing).update(frame, 0.0).in_view


def test_the_lamp_is_seen_between_the_markers():
    rng, tracker = np.random.default_rng(6), new_tracker()
    series = [
        tracker.update(picture((160.0, 120.0), 0.4, rng, lamp=lamp)[0], i / FPS).lamp
        for i, lamp in enumerate((0, 0, 0, 0.5, 1, 1, 0, 0))
    ]
    dark = np.array([series[i] for i in (0, 1, 2, 6, 7)])
    assert np.ptp(dark) < 1.0
    assert min(series[4:6]) > series[3] + 2 > dark.max() + 7


def test_an_empty_scene_and_what_was_seen_of_it():
    tracker = new_tracker()
    rng = np.random.default_rng(7)
    assert not tracker.update(scene.finish(BACKGROUND.copy(), rng), 0.0).in_view
    assert tracker.seen == (False, False)
    frame, _ = picture((160.0, 120.0), 0.0, rng, rear=None)
    assert not tracker.update(frame, 1 / FPS).in_view
    assert tracker.seen == (True, False)
    assert tracker.looks is None


def test_pushed_plate_in_real_footage(shared_data):
    tracker = Tracker(parse_colour("green"), parse_colour("blue"))
    with Video(shared_data / "footage" / "marker-pushed.avi") as video:
        seen = [tracker.update(frame, time) for _, time, frame in video]
    assert len(seen) == 121
    assert all(s.in_view for s in seen)
    places = np.array([pixels_of(s) for s in seen])
    assert np.abs(np.diff(places, axis=0)).max() < 6
    assert math.dist(places[0, 1], (203.4, 105.4)) < 1
    separation = np.hypot(*(places[:, 0] - places[:, 1]).T)
    # The squares touch corner to corner, 15.8 px apart; perspective takes 4 % over the field.
    assert separation.max() < 16.5
    assert separation.min() > 14.6
    for start in range(0, 91, 10):
        second = separation[start : start + 30]
        assert second.std() / second.mean() < 0.01
    axis = places[:, 0] - places[:, 1]
    heading = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
    assert np.abs(np.diff(heading)).max() < 0.12


@pytest.mark.parametrize(("kind", "sd"), [("sensor", 10), ("sensor", 20), ("webcam", 20)])
@pytest.mark.slow
def test_noise_makes_no_pose_of_something_else(shared_data, kind, sd):
    rng = np.random.default_rng(3)
    clean, noisy = new_tracker(colours=("green", "blue")), new_tracker(colours=("green", "blue"))
    results = []
    with Video(shared_data / "footage" / "marker-pushed.avi") as video:
        for _, time, frame in video:
            truth = pixels_of(clean.update(frame, time))
            if kind == "sensor":
                frame = scene.finish(frame, rng, noise=sd, blur=0)
            else:
                frame = scene.webcam_noise(frame, sd, rng)
            sighting = noisy.update(frame, time)
            if sighting.in_view:
                results.append(np.abs(pixels_of(sighting) - truth).max())
    assert max(results) < 5
    assert len(results) > 90
    assert min(each.confidence for each in noisy.seen_colours) > 0.6


@pytest.mark.parametrize("colours", [("green", "blue"), ("blue", "pink")])
@pytest.mark.parametrize(
    "light",
    [
        lambda i: 0.55,
        lambda i: 0.55 if i >= 30 else 1.0,
        lambda i: 0.35 if 30 <= i < 60 else 1.0,
        lambda i: 1.25 if i >= 30 else 1.0,
        lambda i: max(0.3, 1.0 - 0.015 * i),
    ],
    ids=["dim", "dimmed", "dim for a second", "brighter", "ever less"],
)
def test_the_light_may_change(shared_data, colours, light):
    steady, tracker = new_tracker(colours=colours), new_tracker(colours=colours)
    with Video(shared_data / "footage" / "marker-pushed.avi") as video:
        for i, (_, time, frame) in enumerate(video):
            truth = pixels_of(steady.update(frame, time))
            dimmed = np.clip(np.round(light(i) * frame.astype(float)), 0, 255).astype(np.uint8)
            sighting = tracker.update(dimmed, time)
            assert sighting.in_view, i
            assert np.abs(pixels_of(sighting) - truth).max() < 1.5
            if i == 90:
                break
    if light(0) < 1:
        for dim, bright in zip(tracker.seen_colours, steady.seen_colours, strict=True):
            assert dim.confidence > 0.8 * bright.confidence


@pytest.mark.slow
@pytest.mark.parametrize("grey", [0, 2, 6])
def test_a_covered_lens_is_no_other_light(grey):
    rng, tracker, seen = np.random.default_rng(3), new_tracker(), []
    for i, (middle, heading) in enumerate(drive(60)):
        frame, truth = picture(middle, heading, rng)
        if 15 <= i < 40:
            frame = np.full_like(frame, grey)
        sighting = tracker.update(frame, i / FPS)
        seen.append(sighting.in_view)
        if sighting.in_view:
            assert np.abs(pixels_of(sighting) - truth).max() < 1.0
    assert seen[:15] == [True] * 15
    assert not any(seen[15:40])
    assert sum(seen[40:]) >= 15


@pytest.mark.parametrize(("diameter", "noise", "jpeg"), [(6, 4, 75), (8, 8, 60)])
def test_the_least_size_of_markers(diameter, noise, jpeg):
    rng, tracker, misses = np.random.default_rng(12), new_tracker(), []
    for i, (middle, heading) in enumerate(drive(45)):
        image = BACKGROUND.copy()
        robot = {"separation": 2.67 * diameter, "radius": diameter / 2}
        body = (4 * diameter, 1.6 * diameter)
        truth = np.stack(scene.robot(image, middle, heading, body=body, **robot))
        sighting = tracker.update(scene.finish(image, rng, noise=noise, jpeg=jpeg), i / FPS)
        if sighting.in_view:
            misses.append(np.abs(pixels_of(sighting) - truth).max())
    assert len(misses) > 40
    assert max(misses) < 1.5
    assert min(colour.confidence for colour in tracker.seen_colours) > 0.6


def hidden_plate(shared_data, tracker, twin_from=0):
    """Hide the plate that stands still for 3 s of 9 s; return its place before, and all after."""
    with Video(shared_data / "footage" / "marker-pushed.avi") as video:
        forth = [frame for _, _, frame in video]
    before, after = None, []
    for i, frame in enumerate((forth + forth[::-1] + forth)[:270]):
        frame = frame.copy()
        if 26 <= i < 116:
            frame[342:395, 200:245] = frame[250:303, 300:345]
        if i < twin_from:
            frame[205:245, 95:150] = frame[250:290, 300:355]
        sighting = tracker.update(frame, i / FPS)
        if i == 25:
            before = pixels_of(sighting)
        elif i > 25 and sighting.in_view:
            after.append((i, pixels_of(sighting)))
    return before, after


@pytest.mark.slow
@pytest.mark.parametrize("twin_from", [0, 70])
def test_another_plate_is_not_taken_for_one_that_is_hidden(shared_data, twin_from):
    tracker = new_tracker(colours=("blue", "pink"))
    before, after = hidden_plate(shared_data, tracker, twin_from)
    assert max(np.abs(place - before).max() for _, place in after) < 2
    assert sum(i >= 116 for i, _ in after) > 145


def twins(image, where, **robot):
    for middle in where:
        scene.robot(image, middle, 0.4, body=(48, 18), **robot)


@pytest.mark.slow
def test_a_twin_that_was_elsewhere_at_the_loss_is_not_taken():
    rng, tracker, result = np.random.default_rng(10), new_tracker(), []
    for i in range(150):
        image = BACKGROUND.copy()
        own = [] if 20 <= i < 110 else [(80.0, 60.0)]
        # The other one is seen again and again while the robot is hidden, and drives on.
        twins(image, own + ([(240.0 - 0.5 * i, 180.0)] if i >= 10 else []))
        sighting = tracker.update(scene.finish(image, rng), i / FPS)
        if sighting.in_view:
            result.append(i)
            assert np.abs(pixels_of(sighting).mean(axis=0) - (80.0, 60.0)).max() < 1
    assert len(result) > 55


@pytest.mark.slow
def test_of_two_that_both_fit_none_is_taken_and_it_is_counted():
    rng, tracker = np.random.default_rng(11), new_tracker()
    for i in range(120):
        image = BACKGROUND.copy()
        twins(image, [(80.0, 60.0)] if i < 20 else [] if i < 90 else [(60, 180.0), (240.0, 180.0)])
        assert tracker.update(scene.finish(image, rng), i / FPS).in_view == (i < 20)
    assert tracker.undecided > 5


def test_in_nothing_but_noise_nothing_is_found():
    rng, tracker = np.random.default_rng(4), new_tracker()
    for i, sd in enumerate((10, 20, 40, 60)):
        for frame in (
            scene.finish(BACKGROUND, rng, noise=sd),
            scene.webcam_noise(scene.finish(BACKGROUND), sd, rng),
        ):
            assert not tracker.update(frame, i / FPS).in_view


@pytest.mark.parametrize(
    ("front", "rear", "middle"),
    [("yellow", "red", (446.8, 357.7)), ("yellow", "blue", (69.9, 411.1))],
)
def test_what_stands_still_stays_still(shared_data, front, rear, middle):
    tracker = Tracker(parse_colour(front), parse_colour(rear))
    with Video(shared_data / "footage" / "field-static.mp4") as video:
        places = []
        for index, time, frame in video:
            sighting = tracker.update(frame, time)
            assert sighting.in_view
            places.append(pixels_of(sighting))
            if index == 300:
                break
    assert math.dist(np.mean(places, axis=(0, 1)), middle) < 1.0
    assert np.std(places, axis=0).max() < 0.1


#: The six plates of the still field: a pixel on each of their two colours.
PLATES = {
    "red-yellow": ((440, 358), (453, 358)),
    "blue-yellow": ((63, 411), (77, 411)),
    "green-yellow": ((422, 178), (435, 177)),
    "purple-blue": ((243, 210), (257, 213)),
    "orange-purple": ((48, 274), (53, 286)),
    "purple-green": ((75, 371), (75, 386)),
}


@pytest.mark.slow
def test_every_marker_that_stands_still_stays_still(shared_data):
    with Video(shared_data / "footage" / "field-static.mp4") as video:
        trackers = {
            name: Tracker(
                *(colour_at(video.first, click).colour for click in clicks),
                start=np.array(clicks, float),
            )
            for name, clicks in PLATES.items()
        }
        seen = {name: [] for name in PLATES}
        for _, time, frame in video:
            for name, tracker in trackers.items():
                seen[name].append(pixels_of(tracker.update(frame, time)))
    # NaN, where a pair was not found, fails here as well.
    scatter = {name: np.std(places, axis=0).max() for name, places in seen.items()}
    assert all(value < 0.1 for value in scatter.values()), scatter


def test_a_dim_marker_beside_a_bright_one_of_another_colour():
    rng, misses = np.random.default_rng(9), []
    tracker = Tracker(parse_colour("#2d1e6e"), parse_colour("#5aa5f5"))
    for i in range(20):
        image = np.full((240, 320, 3), 20, np.uint8)
        middle = np.array([120.3 + 1.7 * i, 100.2 + 0.6 * i])
        ends = middle, middle + np.array([13.0, 0.0])
        scene.paint_rectangle(image, ends[0], (6.0, 9.0), 0.0, (110, 30, 45))
        scene.paint_rectangle(image, ends[1], (6.0, 9.0), 0.0, (245, 165, 90))
        seen = tracker.update(scene.finish(image, rng), i / FPS)
        assert seen.in_view
        misses.append(pixels_of(seen) - np.stack(ends))
    dim, bright = np.abs(np.mean(misses, axis=0)).max(axis=1)
    assert dim < 0.5
    assert bright < 0.05


def test_a_start_chooses_among_pairs():
    rng, wanted = np.random.default_rng(8), (80.0, 170.0)

    def another(image, centres):
        scene.robot(image, (230.0, 70.0), 0.4, body=(48, 18))

    frame, truth = picture(wanted, 2.0, rng, another)
    start = np.stack(truth) + 3.0
    tracker = Tracker(parse_colour("pink"), parse_colour("blue"), None, start)
    assert np.abs(pixels_of(tracker.update(frame, 0.0)) - truth).max() < 0.15
    assert min(colour.confidence for colour in tracker.seen_colours) > 0.9
    free = new_tracker()
    free.update(frame, 0.0)
    assert max(colour.confidence for colour in free.seen_colours) < 0.7


def test_two_things_that_pass_each_other_are_forgotten():
    rng, tracker, result = np.random.default_rng(9), new_tracker(), []
    for i in range(60):
        image = BACKGROUND.copy()
        if i < 6:  # two moving boxes, and no part of the robot in view
            for v, colour in ((60.0, scene.PINK), (84.0, scene.BLUE)):
                scene.paint_disc(image, (60.0, v), 9.0, (18, 18, 18), fade=False)
                scene.paint_disc(image, (60.0, v), 6.0, colour, fade=False)
        if i < 20:
            tracker.update(scene.finish(image, rng), i / FPS)
            continue
        frame, truth = picture((150.0 + i, 160.0), 0.4, rng)
        sighting = tracker.update(frame, i / FPS)
        if sighting.in_view:
            result.append(np.abs(pixels_of(sighting) - truth).max())
    assert len(result) >= 39
    assert max(result) < 0.15
    assert min(each.confidence for each in tracker.seen_colours) > 0.9
