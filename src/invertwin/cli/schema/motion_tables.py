"""Motions of run-file objects: `[[scene.<name>.motion]]`."""

from torch import Tensor

from invertwin.cli.run_file import prefix_errors
from invertwin.cli.schema import RunFile
from invertwin.cli.schema.shape_tables import ObjectTable, joint_positions, require_body
from invertwin.refusals import refusal
from invertwin.scene import BodyTemplate, MovingScene, ObjectMotion, Scene, Waving
from invertwin.scene.people.gait import PersonMotion


def build_moving_scene(run: RunFile, scene: Scene) -> Scene | MovingScene:
    """The scene as a function of time, or as it is where nothing has a motion.

    Args:
        run: The run file.
        scene: What it describes, at time 0.

    Raises:
        InputError: A motion of people for what is no body, or one that the library refuses.
    """
    movers = {}
    for name, table in run.scene.items():
        if table.motion:
            with prefix_errors(f"scene.{name}"):
                movers[name] = _build_motions(table)
                MovingScene(scene, {name: movers[name]})
    return MovingScene(scene, movers) if movers else scene


def scene_at_start(run: RunFile, scene: Scene, duration: float) -> Scene:
    """The scene as a frame begins; what has a motion has its mean velocity over the frame.

    Args:
        run: The run file.
        scene: What it describes.
        duration: Of the frame [s].
    """
    motion = build_moving_scene(run, scene)
    if isinstance(motion, Scene):
        return motion
    begin, end = motion(0.0), motion(duration)
    for name in motion.motions:
        begin = begin.replace(name, velocity=(end[name].vertices - begin[name].vertices) / duration)
    return begin


def joint_positions_at_start(run: RunFile, scene: Scene) -> dict[str, dict[str, Tensor]]:
    """Return joint positions of bodies at the start of a frame [m], by object and name.

    Args:
        run: The run file.
        scene: From ``scene_at_start``.
    """
    found = {}
    for name, table in run.scene.items():
        truth = run.truth[name].model_dump(exclude_none=True) if name in run.truth else {}
        real, rotations = table.model_copy(update=truth), None
        for mover in _build_motions(real):
            posture = getattr(mover, "posture", None)
            rotations = rotations if posture is None else posture(0.0)[0]
        found[name] = joint_positions(real, scene[name], rotations)
    return {name: joints for name, joints in found.items() if joints}


def refuse_motion(run: RunFile) -> None:
    """Raise where something moves although the data have one ramp a frame.

    Raises:
        InputError: A motion.
    """
    for name, table in run.scene.items():
        if table.motion:
            with prefix_errors(f"scene.{name}.motion"):
                raise refusal("motion_tables.motion_without_chirps")


def _build_motions(table: ObjectTable) -> list[ObjectMotion]:
    """Build the motions of an object; waving replaces the person's own motion meanwhile."""
    found: list[ObjectMotion] = []
    for number, row in enumerate(table.motion):
        with prefix_errors(f"motion[{number}]"):
            if "body" not in row.made_from:
                found.append(row.build())
                continue
            # Breathing adds to the posture that the others give.
            postures = [mover for mover in found if isinstance(mover, PersonMotion)]
            earlier = [] if row.kind == "breathing" else postures
            if earlier and (row.kind != "waving" or isinstance(earlier[0], Waving)):
                raise refusal("motion_tables.two_motions")
            given: dict[type, object] = {type(mover): mover for mover in earlier}
            got = "another; give it this shape, or choose another motion"
            body = earlier[0].body if earlier else require_body(table, got)
            found = [mover for mover in found if mover not in earlier]
            found.append(row.build({BodyTemplate: body, **given}))
    return found
