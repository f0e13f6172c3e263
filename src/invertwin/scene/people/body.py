"""Articulated bodies: skin, or rigid parts, on a tree of joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from invertwin.checks import ArrayLike, check_shape, checked_count, checked_tensor, set_fields
from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh, concatenate_meshes
from invertwin.scene.parameters import Entries, ObjectModule, axes_mask, free_part
from invertwin.scene.pose import from_frame, rotation_angle, rotation_from_vector
from invertwin.storage.untrusted import existing_file, read_arrays, safe_reader

_DO = "give arrays of one template"
_SINGLE_JOINT_WEIGHT = 0.95  # skinning weight of a vertex dominated by one joint
_EXACT = 1e-12  # tolerance of the Newton steps [m]
_MAX_REFINEMENTS = 4  # Newton steps of least squares


@dataclass(frozen=True, eq=False)
class BodyTemplate:
    """Rest mesh, joint tree and skinning weights of a body.

    Attributes:
        vertices: rest positions [m].
        faces: vertex indices of every triangle.
        weights: skinning weight of every joint in every vertex [v, j]; rows sum to 1.
        parents: parent of each joint, always an earlier one; −1 for the first, the root.
        joints: rest positions of the joints [m].
        shape_directions: derivatives of the vertices with respect to shape coordinates [m]; None:
            no shape coordinates.
        joint_directions: derivatives of the joints with respect to shape coordinates [m].
        pose_directions: derivatives of the rest positions with respect to the elements of R − I of
            all joints but the root, row by row; None: no pose correctives.
        names: names of the joints; empty if unnamed.

    Raises:
        InputError: shapes that do not fit together, NaN, weights that are negative or do not add
            up to 1, parents that are not a tree, or names that are not one for each joint.
    """

    vertices: Float64[Tensor, "v 3"]
    faces: Int64[Tensor, "f 3"]
    weights: Float64[Tensor, "v j"]
    parents: tuple[int, ...]
    joints: Float64[Tensor, "j 3"]
    shape_directions: Float64[Tensor, "v 3 n"] | None = None
    joint_directions: Float64[Tensor, "j 3 n"] | None = None
    pose_directions: Float64[Tensor, "v 3 p"] | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        mesh = Mesh(self.vertices, self.faces)
        rows, parents = len(mesh.vertices), tuple(int(p) for p in self.parents)
        count = len(parents)
        if not count or parents[0] != -1 or any(not 0 <= p < k for k, p in enumerate(parents) if k):
            raise InputError(
                "expected parents −1 for the first joint and an earlier joint for each other, "
                f"got {parents}; sort the joints from the root outwards"
            )
        weights = checked_tensor(self.weights, (rows, count), "skinning weights", _DO)
        off = float((weights.sum(1) - 1).abs().max())
        if float(weights.min()) < 0 or off > 1e-3:
            raise InputError(
                "expected skinning weights >= 0 that add up to 1 at each vertex, got a least one "
                f"of {float(weights.min()):.3g} and sums {off:.3g} off; normalise them"
            )
        weights = weights / weights.sum(1, keepdim=True)
        joints = checked_tensor(self.joints, (count, 3), "joints [m]", _DO)
        set_fields(self, weights=weights, parents=parents, joints=joints, **vars(mesh))
        if self.names and (len(self.names) != count or len(set(self.names)) != count):
            raise InputError(
                f"expected a name of its own for each of {count} joints, got {len(self.names)} "
                f"names, {len(set(self.names))} of them different; give one each or none"
            )
        if (self.shape_directions is None) != (self.joint_directions is None):
            raise InputError(
                "expected shape directions of vertices and of joints, got one of them; give both"
            )
        if self.shape_directions is not None:
            shapes = checked_tensor(self.shape_directions, (rows, 3, None), "shape directions", _DO)
            places = (count, 3, shapes.shape[2])
            bones = checked_tensor(self.joint_directions, places, "joint directions", _DO)
            set_fields(self, shape_directions=shapes, joint_directions=bones)
        if self.pose_directions is not None:
            columns = (rows, 3, 9 * (count - 1))
            poses = checked_tensor(self.pose_directions, columns, "pose directions", _DO)
            set_fields(self, pose_directions=poses)

    @property
    def shape_count(self) -> int:
        """Number of shape coordinates."""
        return 0 if self.shape_directions is None else self.shape_directions.shape[2]

    def joint(self, name: str | int) -> int:
        """Return the index of a joint, given its name or its index.

        Raises:
            InputError: no such joint.
        """
        if isinstance(name, str):
            if name not in self.names:
                known = ", ".join(self.names) or "none: this template's joints have numbers only"
                raise InputError(f"expected a joint among {known}, got {name!r}; choose one")
            return self.names.index(name)
        if not 0 <= name < len(self.parents):
            raise InputError(
                f"expected joints in [0, {len(self.parents) - 1}], got {name}; "
                "count the template's from 0"
            )
        return name

    def rotations(self, turns: Mapping[str, ArrayLike]) -> Float64[Tensor, "j 3"]:
        """Return rotation vectors of all joints, given those of some by name; the others are at
        rest.

        Args:
            turns: rotation vectors in the frame of the joint's parent [rad].

        Raises:
            InputError: no such joint, or not three finite numbers.
        """
        found = torch.zeros(len(self.parents), 3, dtype=torch.float64)
        for name, turn in turns.items():
            what = f"rotation of {name} [rad]"
            found[self.joint(name)] = checked_tensor(turn, (3,), what, "give x, y and z")
        return found

    def mesh(self, turns: Mapping[str, ArrayLike]) -> Mesh:
        """Return the skin with some joints rotated, the others at rest.

        Args:
            turns: as in `rotations`.

        Raises:
            InputError: no such joint, or not three finite numbers.
        """
        return Mesh(self.apply_pose(rotation_from_vector(self.rotations(turns)))[0], self.faces)

    def scale(self, factor: float) -> "BodyTemplate":
        """Return the scaled body."""
        given = ("vertices", "joints", "shape_directions", "joint_directions", "pose_directions")
        values = {name: getattr(self, name) for name in given}
        return replace(self, **{n: v if v is None else v * factor for n, v in values.items()})

    def estimate_rotations(self, vertices: Float64[Tensor, "v 3"]) -> Float64[Tensor, "j 3"]:
        """Estimate rotation vectors of all joints from a posed skin [rad], the inverse of
        `apply_pose`.

        Least squares over the vertices; joints without vertices stay at rest. The skin has the
        template's own shape.

        Raises:
            InputError: another number of vertices than the template's.
        """
        given = checked_tensor(vertices, tuple(self.vertices.shape), "vertices [m]", _DO).detach()
        turns = self._estimate_rigid_rotations(given)

        def skin(flat: Tensor) -> Tensor:
            return self.apply_pose(rotation_from_vector(flat.reshape(-1, 3)))[0].flatten()

        with torch.no_grad():
            for _ in range(_MAX_REFINEMENTS):
                miss = given.flatten() - skin(turns.flatten())
                if float(miss.abs().max()) < _EXACT:
                    break
                slopes = torch.func.jacfwd(skin)(turns.flatten())
                change = torch.linalg.lstsq(slopes, miss[:, None], driver="gelsd").solution
                turns = turns + change.reshape(-1, 3)
        return turns

    def _estimate_rigid_rotations(self, given: Tensor) -> Tensor:
        """Estimate initial rotation vectors from vertices dominated by one joint."""
        frames: list[Rotation] = []
        for joint, parent in enumerate(self.parents):
            frames.append(frames[parent] if joint else Rotation.identity())
            own = self.weights[:, joint] > _SINGLE_JOINT_WEIGHT
            if int(own.sum()) >= 3:
                rest, now = ((p[own] - p[own].mean(0)).numpy() for p in (self.vertices, given))
                frames[joint] = Rotation.align_vectors(now, rest)[0]
        pairs = zip(self.parents[1:], frames[1:], strict=True)
        turns = [frames[0], *(frames[parent].inv() * frame for parent, frame in pairs)]
        return torch.from_numpy(np.stack([turn.as_rotvec() for turn in turns]))

    def apply_pose(
        self, rotations: Float64[Tensor, "j 3 3"], shape: Float64[Tensor, " n"] | None = None
    ) -> tuple[Float64[Tensor, "v 3"], Float64[Tensor, "j 3"]]:
        """Return vertices and joints [m] with every joint rotated relative to its parent.

        Linear blend skinning: ``x = Σ_j w_j (R_j (v − p_j) + t_j)``, R_j and t_j rotation and
        position of joint j in the object's frame, p_j its rest position.

        Args:
            rotations: rotation matrices of every joint in the frame of its parent.
            shape: shape coordinates; None = the template's own shape.
        """
        rest, places = self.vertices, self.joints
        if shape is not None and self.shape_directions is not None:
            rest = rest + self.shape_directions @ shape
            places = places + self.joint_directions @ shape  # type: ignore[operator]
        if self.pose_directions is not None:
            turned = rotations[1:] - torch.eye(3, dtype=torch.float64)
            rest = rest + self.pose_directions @ turned.flatten()
        frames, moved = [rotations[0]], [places[0]]
        for joint, parent in enumerate(self.parents[1:], start=1):
            moved.append(moved[parent] + frames[parent] @ (places[joint] - places[parent]))
            frames.append(frames[parent] @ rotations[joint])
        turns, posed = torch.stack(frames), torch.stack(moved)
        shifts = posed - torch.einsum("jab,jb->ja", turns, places)
        blended = torch.einsum("vj,jab->vab", self.weights, turns)
        return torch.einsum("vab,vb->va", blended, rest) + self.weights @ shifts, posed


class SkinnedBody(ObjectModule):
    """Replace an object's mesh by a posed body template.

    Args:
        object: name of the object; its pose places the body.
        template: body template.
        rotation: initial rotation vectors [j, 3] [rad]; None = rest pose.
        shape: initial shape coordinates [n]; None = zero.
        joints: free joints, by name or index, or a mapping from their names to the free components
            of the rotation vector, such as "z" for an elbow; None = all.

    Attributes:
        rotation: parameter [j, 3], rotation vector of every joint in the frame of its parent
            [rad].
        shape: parameter [n], shape coordinates of the template.

    Raises:
        InputError: wrong shapes, NaN, a joint that the template does not have, or axes that
            are not some of x, y and z.
    """

    def __init__(
        self,
        object: str,
        template: BodyTemplate,
        rotation: ArrayLike | None = None,
        shape: ArrayLike | None = None,
        joints: Sequence[str | int] | Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(object)
        self.template = template
        count, shapes = len(template.parents), template.shape_count
        turns = torch.zeros(count, 3) if rotation is None else rotation
        turns = checked_tensor(turns, (count, 3), "joint rotations [rad]", "give one per joint")
        given = torch.zeros(shapes) if shape is None else shape
        given = checked_tensor(given, (shapes,), "shape coordinates", "give the template's")
        chosen = range(count) if joints is None else joints
        free = chosen if isinstance(chosen, Mapping) else dict.fromkeys(chosen, "xyz")
        self._free = torch.zeros(count, 3, dtype=torch.float64)
        self._joints = {str(name): template.joint(name) for name in free}
        for name, axes in free.items():
            if not axes:
                raise InputError(f"expected axes among x, y and z for {name}, got none; give some")
            self._free[template.joint(name)] = axes_mask(axes)
        self.rotation = nn.Parameter(turns.detach().clone())
        self.shape = nn.Parameter(given.detach().clone(), requires_grad=shapes > 0)

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the posed skin of the template."""
        return Mesh(self._apply_pose()[0], self.template.faces)

    @classmethod
    def from_mesh(
        cls, object: str, template: BodyTemplate, mesh: Mesh, joints: Mapping[str, str]
    ) -> "SkinnedBody":
        """Build the body from the joint angles of a posed mesh, with the template's shape.

        Args:
            object: name of the object.
            template: body template.
            mesh: posed mesh with the template's triangles.
            joints: as in the class.

        Raises:
            InputError: other vertices, or a joint that the template does not have.
        """
        for name in joints:
            template.joint(name)
        found = cls(object, template, template.estimate_rotations(mesh.vertices), joints=joints)
        found.shape.requires_grad_(False)
        return found

    def perturb_joints(self, mesh: Mesh, angle: float, generator: torch.Generator) -> Mesh:
        """Return a mesh of the body with every free joint rotated by `angle` [rad] about random
        axes.

        Args:
            mesh: posed mesh of the body.
            angle: rotation angle [rad].
            generator: random number generator of the axes.
        """
        turns = self.template.estimate_rotations(mesh.vertices)
        rotations = rotation_from_vector(turns)
        for joint in self._joints.values():
            free = self._free[joint]
            axis = torch.randn(3, generator=generator, dtype=torch.float64).roll(1) * free
            change = angle * axis / axis.norm()
            # A hinge keeps its axis.
            rotations[joint] = (
                rotation_from_vector(turns[joint] + change)
                if int(free.sum()) == 1
                else rotation_from_vector(change) @ rotations[joint]
            )
        return Mesh(self.template.apply_pose(rotations)[0], mesh.faces)

    def joint_errors(self, estimate: Mesh, truth: Mesh) -> dict[str, float]:
        """Return the angles [rad] between the free joints of two meshes of the body, by name.

        Args:
            estimate, truth: estimated and true mesh.
        """
        turns = [self.template.estimate_rotations(mesh.vertices) for mesh in (estimate, truth)]
        a, b = map(rotation_from_vector, turns)
        angles = rotation_angle(a.mT @ b).tolist()
        return {name: angles[joint] for name, joint in self._joints.items()}

    def joints(self) -> Float64[Tensor, "j 3"]:
        """Return the present positions of the joints in the object's frame [m]."""
        return self._apply_pose()[1]

    def values(self) -> dict[str, Tensor]:
        """Return rotations [rad] of the free joints and shape coordinates, by name."""
        turns = self.rotation.detach().clone()
        named = {f"{self.object}.joint_rotation": turns}
        if self.template.names:
            free = [int(joint) for joint in self._free.any(1).nonzero()[:, 0]]
            named = {f"{self.object}.{self.template.names[joint]}": turns[joint] for joint in free}
        if self.template.shape_count:
            named[f"{self.object}.shape"] = self.shape.detach().clone()
        return named

    def entries(self) -> dict[str, Entries]:
        """Return the rotation vectors [rad] of the named free joints."""
        joints = enumerate(self.template.names)
        return {name: Entries("rotation", k) for k, name in joints if self._free[k].any()}

    def _apply_pose(self) -> tuple[Tensor, Tensor]:
        rotations = rotation_from_vector(free_part(self.rotation, self._free))
        return self.template.apply_pose(rotations, self.shape)


def articulated_template(
    parts: Sequence[Mesh], parents: Sequence[int], joints: ArrayLike
) -> BodyTemplate:
    """Build a body of rigid parts, part k rotating about joint k.

    Args:
        parts: a mesh for every joint, in the rest pose and one common frame.
        parents: parent of each joint, −1 for the first.
        joints: rest positions [j, 3] of the joints [m].

    Raises:
        InputError: numbers of parts and joints that differ, or parents that are not a tree.
    """
    if not parts or len(parts) != len(parents):
        raise InputError(
            f"expected a mesh for each of {len(parents)} joints, got {len(parts)}; give one each"
        )
    sizes = [len(part.vertices) for part in parts]
    owner = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor(sizes))
    whole = concatenate_meshes(parts)
    weights = torch.nn.functional.one_hot(owner, len(parts)).double()
    places = checked_tensor(joints, (len(parts), 3), "joints [m]", "give one per part")
    return BodyTemplate(whole.vertices, whole.faces, weights, tuple(parents), places)


@safe_reader("a body model")
def load_smpl(file: str | Path, shapes: int = 10) -> BodyTemplate:
    """Load a body in SMPL's ``.npz`` layout, which users obtain under its own licence.

    It reads ``v_template`` [v, 3], ``f``, ``weights`` [v, j], ``kintree_table`` [2, j],
    ``J_regressor`` [j, v], ``shapedirs`` [v, 3, n] and, if there, ``posedirs`` [v, 3, 9 (j − 1)].
    SMPL's bodies face z, y up; the template faces −x, z up. A joint's rotation vector (x, y, z) of
    SMPL is (−z, −x, y) here.

    Args:
        file: path of the file.
        shapes: number of leading shape coordinates to keep.

    Raises:
        InputError: no such file, pickled objects in it, or arrays missing or of wrong shapes.
    """
    path = existing_file(file, "a body model")
    names = ("v_template", "f", "weights", "kintree_table", "J_regressor", "shapedirs")
    do = "save sparse matrices and pickled objects as arrays with numpy.savez first"
    arrays = read_arrays(path, do, (*names, "posedirs"))
    for name in names:
        if name not in arrays:
            do = "give a file of SMPL's layout"
            raise InputError(f"expected {name} in {path.name}, got no {name}; {do}")
    turn: Tensor = from_frame(torch.eye(3, dtype=torch.float64), "smpl").T
    rest = checked_tensor(arrays["v_template"], (None, 3), "v_template", _DO) @ turn.T
    table = arrays["kintree_table"].astype(np.int64)
    check_shape(torch.from_numpy(table), (2, None), "kintree_table", "give a file of SMPL's layout")
    count = table.shape[1]
    directions = checked_tensor(arrays["shapedirs"], (len(rest), 3, None), "shapedirs", _DO)
    directions = turn @ directions[..., : checked_count(shapes, "shape coordinates", 1)]
    regressor = checked_tensor(arrays["J_regressor"], (count, len(rest)), "J_regressor", _DO)
    poses = None
    if "posedirs" in arrays:
        poses = checked_tensor(arrays["posedirs"], (len(rest), 3, 9 * (count - 1)), "posedirs", _DO)
        # The correctives and the rotation matrices that they belong to turn alike.
        poses = poses.unflatten(2, (-1, 3, 3))
        poses = torch.einsum("ab,cd,ef,vbjdf->vajce", turn, turn, turn, poses).flatten(2)
    faces = torch.from_numpy(arrays["f"].astype(np.int64))
    weights = checked_tensor(arrays["weights"], (len(rest), count), "weights", _DO)
    # The parent of the root is arbitrary, 2³² − 1 in most files.
    skeleton = (-1, *(int(parent) for parent in table[0, 1:])), regressor @ rest
    moved = directions, torch.einsum("jv,van->jan", regressor, directions), poses
    return BodyTemplate(rest, faces, weights, *skeleton, *moved)
