"""Clothes over the open body: the surface of a dressed person in any pose, on the body's own vertices.

A wardrobe cuts an outfit to a person once. Worn in a pose, the cloth is the body's surface, smoothed so that details of
the body do not show, moved outwards by the width of the garment, more below a limb than above, and folded: deepest
where the pose shortens the surface. `docs/reference/clothes.md` lists what is modelled and what is not.

Cloth is computed by sparse linear operators on the mesh, whose long edges are divided where it is too coarse for folds.
Folds are waves on the surface of the person at rest, one pattern for each direction of compression.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.outfits import Outfit, cut
from bodyseg_data.bodies.skeleton import Floats
from bodyseg_data.core import Draws
from bodyseg_data.meshes import face_normals, find_edges, vertex_normals

Faces = NDArray[np.int64]

DIRECTIONS: Final = (0.0, 0.25 * np.pi, 0.5 * np.pi, 0.75 * np.pi)
"""Angles from the garment's axis across which the patterns wave: rings, two diagonals, lengthwise folds."""

_ACROSS: Final = 0.55  # half-widths of a kernel, in wavelengths: across its waves, along them, through the body
_ALONG: Final = 2.8
_THROUGH: Final = 0.8
_REACH: Final = 5.0  # wavelengths, beyond which a kernel has faded
_OVERLAP: Final = 2.5  # kernels over each point
_WAVE_SPREAD: Final = 0.25  # standard deviation of a kernel's log wavelength, and of its angle in radians
_QUIET: Final = 0.3  # energy, compared with one kernel's, below which the surface is smooth

FINE_M: Final = 0.022
"""Longest edge that still carries the folds: half the shortest wavelength. Finer meshes come from `Refinement`."""

_THICKNESS_M: Final = 0.004  # of cloth: its smallest distance from the skin
_SMOOTH_M: Final = 0.03  # detail of the body much smaller than this does not show through
_DIFFUSION_M: Final = 0.035  # over which the width of a garment is evened out
_HANG: Final = 0.9  # cloth stands off by 1 + this of its width below a level limb, by 1 - this above it
_MOST_SHORTENED: Final = 0.25  # beyond, cloth slides along the body instead of folding deeper
_DEEPEST_M: Final = 0.022
_AT_REST: Final = np.array([0.1, 0.6, 1.0, 0.6])  # share of an outfit's slack that folds across each of DIRECTIONS
_AT_ENDS: Final = np.array([1.0, 0.5, 0.2, 0.5])  # the same of its crumple
_SMOOTHINGS: Final = 3  # times that normals are averaged over neighbours: flat triangles would show in wide cloth
_DECIMALS: Final = 6  # to the micrometre, as the body


class Smoother:
    """Smooths positions over a given length, for triangles of any size; vertices that are not free stay fixed.

    Solves (M + t^4 L M^-1 L) x = M x0, with L the cotangent Laplacian at rest: implicit fairing (Desbrun et al. 1999)
    of second order, which shrinks limbs far less than the first order.
    """

    def __init__(self, points: Floats, faces: Faces, free: NDArray[np.bool_], length_m: float) -> None:
        from scipy.sparse import diags
        from scipy.sparse.linalg import splu

        laplacian, mass = cotangent_laplacian(points, faces, np.zeros(len(points), np.int64))
        system = (diags(mass) + length_m**4 * laplacian @ diags(1 / mass) @ laplacian).tocsr()
        self._free, self._mass = free, mass[free, None]
        self._solver = splu(system[free][:, free].tocsc())
        self._held = system[free][:, ~free]

    def __call__(self, points: Floats) -> Floats:
        """Return positions [N, 3], smoothed."""
        smooth = points.copy()
        smooth[self._free] = self._solver.solve(self._mass * points[self._free] - self._held @ points[~self._free])
        return smooth


def diffused(values: Floats, points: Floats, faces: Faces, group: NDArray[np.int64], length_m: float) -> Floats:
    """Diffuse values [N] over a length within each group of vertices, by one step of heat: (M + t^2 L) x = M x0."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    laplacian, mass = cotangent_laplacian(points, faces, group)
    return np.asarray(splu((diags(mass) + length_m**2 * laplacian).tocsc()).solve(mass * values), np.float64)


def cotangent_laplacian(points: Floats, faces: Faces, group: NDArray[np.int64]) -> tuple[Any, Floats]:
    """Return the sparse Laplacian [N, N], linking vertices of one group only, and the surface area [N] at each vertex.

    Weights of obtuse corners are lifted to a small positive one, so that no value leaves the range of its neighbours.
    """
    from scipy.sparse import csr_matrix, diags

    count = len(points)
    rows, columns, values = [], [], []
    mass = np.zeros(count)
    for corner in range(3):
        i, j, k = (faces[:, (corner + step) % 3] for step in range(3))
        u, v = points[j] - points[i], points[k] - points[i]
        area = np.linalg.norm(np.cross(u, v), axis=1)
        cotangent = np.clip(np.einsum("ij,ij->i", u, v) / np.maximum(area, 1e-12), 0.02, 20) / 2
        linked = np.where(group[j] == group[k], cotangent, 0.0)
        rows += [j, k]
        columns += [k, j]
        values += [linked, linked]
        mass += np.bincount(i, weights=area / 6, minlength=count)
    links = csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(count,) * 2)
    return diags(np.asarray(links.sum(axis=1)).ravel()) - links, mass


def patch(faces: NDArray[np.int32], covered: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Faces]:
    """Return the covered vertices and two rings around them [N], and their faces [F, 3] in that numbering."""
    wide = covered
    for _ in range(2):
        touched = faces[wide[faces].any(axis=1)]
        wide = np.zeros_like(covered)
        wide[touched] = True
    numbers = np.cumsum(wide) - 1
    return np.flatnonzero(wide), numbers[faces[wide[faces].all(axis=1)]]


def gathering(faces: Faces, count: int) -> Any:
    """Return the sparse matrix [N, F] that sums over the faces around each vertex."""
    from scipy.sparse import csr_matrix

    columns = np.repeat(np.arange(len(faces)), 3)
    return csr_matrix((np.ones(faces.size), (faces.ravel(), columns)), shape=(count, len(faces)))


def averaging(faces: Faces, group: NDArray[np.int64]) -> Any:
    """Return the sparse matrix [N, N] that averages each vertex and its neighbours in the same group."""
    from scipy.sparse import csr_matrix, diags, identity

    count = len(group)
    rows, columns = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    same = group[rows] == group[columns]
    links = csr_matrix((np.ones(same.sum()), (rows[same], columns[same])), shape=(count, count))
    links = ((links + links.T) > 0).astype(np.float64) + identity(count)
    return (diags(1 / np.asarray(links.sum(axis=1)).ravel()) @ links).tocsr()


def sliding(partner: NDArray[np.int64], share: Floats, vertices: NDArray[np.int64]) -> Any:
    """Return the sparse matrix [N, N] that moves each vertex of a patch its share ([V]) towards its partner ([V])."""
    from scipy.sparse import csr_matrix

    numbers = np.zeros(len(partner), np.int64)
    numbers[vertices] = np.arange(len(vertices))
    rows = np.arange(len(vertices))
    values = np.concatenate([1 - share[vertices], share[vertices]])
    columns = np.concatenate([rows, numbers[partner[vertices]]])
    return csr_matrix((values, (np.tile(rows, 2), columns)), shape=(len(vertices),) * 2)


class Refinement:
    """Splits long edges of one topology at their middles; faces stay on the surface and keep their orientation.

    faces: int32 [F', 3]. Old vertices keep their numbers and new ones follow, so landmarks by vertex stay valid.
    """

    def __init__(self, rest: Floats, faces: NDArray[np.int32], longest_m: float, rounds: int = 2) -> None:
        self._ends: list[NDArray[np.int64]] = []
        points, self.faces = rest, faces
        for _ in range(rounds):
            ends, self.faces = _split(points, self.faces, longest_m)
            self._ends.append(ends)
            points = np.concatenate([points, points[ends].mean(axis=1)])

    def __call__(self, vertices: Floats) -> Floats:
        """Refine vertices [V, 3] of the coarse mesh in any pose to [V', 3]."""
        for ends in self._ends:
            vertices = np.concatenate([vertices, vertices[ends].mean(axis=1)])
        return vertices


def _split(points: Floats, faces: NDArray[np.int32], longest_m: float) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return the ends [N, 2] of split edges, whose middles are numbered after the last vertex, and the new faces."""
    edges = find_edges(faces)
    long = edges.lengths(points) > longest_m
    number = np.where(long, len(points) + np.cumsum(long) - 1, -1)
    middle = number[edges.of_side]
    count = (middle >= 0).sum(axis=1)
    new = [faces[count == 0]]
    for split, corner in ((1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (3, 0)):
        # Turned so that the one split edge is the first, or the one whole edge the last.
        turn = (corner, (corner + 1) % 3, (corner + 2) % 3)
        fit = (count == split) & ((middle[:, corner] >= 0) if split == 1 else (middle[:, turn[2]] < 0) | (split == 3))
        (a, b, c), (ab, bc, ca) = faces[fit][:, turn].T, middle[fit][:, turn].T
        parts = {
            1: ((a, ab, c), (ab, b, c)),
            2: ((ab, b, bc), (a, ab, c), (ab, bc, c)),
            3: ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
        }[split]
        new += [np.stack(part, axis=1) for part in parts]
    return edges.ends[long], np.concatenate(new).astype(np.int32)


def fold_patterns(points: Floats, normals: Floats, axes: Floats, areas: Floats, wave_m: float, seed: int) -> Floats:
    """Make Gabor noise on a surface (Lagae et al. 2009), a pattern for each of DIRECTIONS: float64 [N, 4], -1 to 1.

    points, normals, axes: float64 [N, 3]; axes are tangent unit vectors. areas: [N], of surface around each point.
    """
    patterns = np.zeros((len(points), len(DIRECTIONS)))
    count = max(1, round(_OVERLAP * areas.sum() / (np.pi * _ACROSS * _ALONG * wave_m**2)))
    for column, angle in enumerate(DIRECTIONS):
        draws = Draws(seed, 0, "open/clothes").generator(f"folds {column}")
        centres = np.searchsorted(np.cumsum(areas), draws.random(count) * areas.sum())
        waves = wave_m * np.exp(_WAVE_SPREAD * draws.standard_normal(count))
        turns = angle + _WAVE_SPREAD * draws.standard_normal(count)
        phases = 2 * np.pi * draws.random(count)
        value, energy = np.zeros(len(points)), np.full(len(points), _QUIET)
        for centre, wave, turn, phase in zip(centres, waves, turns, phases, strict=True):
            away, facing = points - points[centre], normals @ normals[centre]
            # Folds do not continue on the far side of a limb.
            near = np.flatnonzero((facing > 0) & (np.einsum("ij,ij->i", away, away) <= (_REACH * wave) ** 2))
            axis, around = axes[centre], np.cross(normals[centre], axes[centre])
            ways = [np.cos(turn) * axis + np.sin(turn) * around, np.cos(turn) * around - np.sin(turn) * axis]
            across, along, through = np.stack([*ways, normals[centre]]) @ away[near].T / wave
            fade = np.exp(-0.5 * ((across / _ACROSS) ** 2 + (along / _ALONG) ** 2 + (through / _THROUGH) ** 2))
            fade *= facing[near]
            value[near] += fade * np.cos(2 * np.pi * across + phase)
            energy[near] += fade**2
        patterns[:, column] = (np.exp(1.43 * (value / np.sqrt(energy))) - 1.9) / 2.2
    return patterns


class Wardrobe:
    """One person's clothes, cut once and worn in any pose. covered: bool [V], the vertices that clothes move."""

    def __init__(self, rest: Floats, faces: NDArray[np.int32], outfit: Outfit) -> None:
        """Cut `outfit` to a person.

        rest: float64 [V, 3], metres, body frame, standing straight with hanging arms, in the numbering of the open
        body or of a `Refinement` of it. faces: int32 [F, 3].
        """
        pieces = cut(rest, faces, outfit)
        self.covered: NDArray[np.bool_] = pieces.top | pieces.trousers
        self._vertices, self._faces = patch(faces, self.covered)
        points = rest[self._vertices]
        self._free = self.covered[self._vertices]
        self._cover = self._free.astype(np.float64)[:, None]
        garment = np.where(pieces.top, 1, np.where(pieces.trousers, 2, 0))[self._vertices]
        self._gather = gathering(self._faces, len(points))
        self._average = averaging(self._faces, garment)
        self._slide = sliding(pieces.partner, pieces.slide, self._vertices)
        self._smoother = Smoother(points, self._faces, self._free, _SMOOTH_M)
        self._stand_off = diffused(pieces.stand_off[self._vertices], points, self._faces, garment, _DIFFUSION_M)
        self._slack = outfit.slack * _AT_REST + pieces.crumple[self._vertices, None] * _AT_ENDS
        normals = vertex_normals(points, self._faces)
        axes = _tangent(pieces.axis[self._vertices], normals)
        areas = self._gather @ np.linalg.norm(face_normals(points, self._faces), axis=1) / 6
        self._patterns = fold_patterns(points, normals, axes, areas, outfit.fold_m, outfit.seed)
        self._wave = outfit.fold_m
        self._rest_areas, self._frames = self._rest_frames(points, axes)

    def worn(self, vertices: Floats) -> Floats:
        """Return the dressed surface [V, 3] of the posed body `vertices` [V, 3], metres, body frame.

        Vertices that no garment covers come back as they are, bit for bit. The cloth changes smoothly with the pose.
        """
        shortened = self._shortened(vertices[self._vertices])
        body = self._slide @ vertices[self._vertices]
        calm = self._smoother(body)
        out = vertex_normals(calm, self._faces)
        for _ in range(_SMOOTHINGS):
            out = self._average @ out
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
        width = self._stand_off * (1 - _HANG * out[:, 1])
        # A strip with an excess length of share s has waves of amplitude wavelength / pi * sqrt(s).
        depths = self._wave / np.pi * np.sqrt(self._slack + shortened)
        folds = _DEEPEST_M * np.tanh((depths * self._patterns).sum(axis=1) / _DEEPEST_M)
        cloth = self._outside(calm + self._cover * (_THICKNESS_M + width + folds)[:, None] * out, body, out)
        cloth += 0.5 * self._cover * (self._average @ cloth - cloth)
        cloth = self._outside(cloth, body, out)
        dressed = vertices.copy()
        dressed[self._vertices[self._free]] = np.round(cloth[self._free], _DECIMALS) + 0.0
        return dressed

    def _outside(self, cloth: Floats, body: Floats, out: Floats) -> Floats:
        """Push cloth along `out` where it is closer to the body than its thickness."""
        gap = np.einsum("ij,ij->i", cloth - body, out)[:, None]
        return np.asarray(cloth + self._cover * np.maximum(_THICKNESS_M - gap, 0) * out, np.float64)

    def _rest_frames(self, points: Floats, axes: Floats) -> tuple[Floats, Floats]:
        """Return double areas [F] at rest, and the inverse [F, 2, 2] of each triangle's edges in (axis, around it)."""
        across = face_normals(points, self._faces)
        areas = np.linalg.norm(across, axis=1)
        across /= np.maximum(areas, 1e-15)[:, None]
        axis = _tangent(axes[self._faces].sum(axis=1), across)
        frame = np.stack([axis, np.cross(across, axis)], axis=1)
        (a, b), (c, d) = np.moveaxis(frame @ self._edges(points), 0, 2)
        # Written out: a linear-algebra library would be called once a triangle, and its threads wait for each other.
        inverse = np.moveaxis(np.array([[d, -b], [-c, a]]) / np.maximum(a * d - b * c, 1e-15), 2, 0)
        return areas, np.ascontiguousarray(inverse)

    def _edges(self, points: Floats) -> Floats:
        a, b, c = (points[self._faces[:, corner]] for corner in range(3))
        return np.stack([b - a, c - a], axis=2)

    def _shortened(self, points: Floats) -> Floats:
        """Return the share by which the surface is shorter than at rest in each of DIRECTIONS, [N, 4]; 0 if longer."""
        b, c = np.moveaxis(self._edges(points), 2, 0)
        x, y = (b * self._frames[:, 0, way, None] + c * self._frames[:, 1, way, None] for way in (0, 1))
        metric = np.stack([np.einsum("fi,fi->f", u, v) for u, v in ((x, x), (x, y), (y, y))], axis=1)
        metric = self._gather @ (metric * self._rest_areas[:, None]) / (self._gather @ self._rest_areas)[:, None]
        for _ in range(_SMOOTHINGS):
            metric = self._average @ metric
        cosine, sine = np.cos(DIRECTIONS), np.sin(DIRECTIONS)
        lengths = np.sqrt(np.maximum(metric @ np.stack([cosine**2, 2 * cosine * sine, sine**2]), 1e-4))
        return np.asarray(np.clip(1 - lengths, 0, _MOST_SHORTENED), np.float64)


def _tangent(ways: Floats, normals: Floats) -> Floats:
    """Return unit vectors along the components of `ways` [N, 3] perpendicular to `normals` [N, 3]."""
    ways = ways - np.einsum("ij,ij->i", ways, normals)[:, None] * normals
    return np.asarray(ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12), np.float64)
