"""The wording of errors that users meet, each line once; other tests pin the kind of an error and the value in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodyseg_data import RangeImages, loader
from bodyseg_data.artifacts import Augmentation
from bodyseg_data.bodies import open_source
from bodyseg_data.bodies.sources.paper import ScapeBodies
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh, BadSample, BodysegError
from bodyseg_data.labels import colour_labels
from bodyseg_data.meshes import LandmarkSet, Mesh, load_landmarks, partition, read_mesh
from bodyseg_data.meshes.geodesics import nearest_sources
from bodyseg_data.packing import Packing, check_engine
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rigs import Camera, load_rig
from bodyseg_data.samples import ViewGrid, check_key, steps
from bodyseg_data.shards import encode_sample, read_manifest
from bodyseg_data.shards.sample_codec import decode_sample
from bodyseg_model.networks import build, load_network
from bodyseg_model.recordings import metres_a_step
from bodyseg_model.segmentation import Background, Segmenter

NONE: Any = None
NUMBER: Any = 3
NAME: Any = "hot"
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
LENS = Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
FACES: Any = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)

Case = tuple[Callable[[], Any], type[BodysegError], str]

CASES: dict[str, Case] = {
    "read a set that is not there": (lambda: RangeImages("none"), BadConfig, "no such folder: none"),
    "read a set by a number": (
        lambda: RangeImages(NUMBER),
        BadConfig,
        "path must be that of a set, as text or a Path, found 3",
    ),
    "read a manifest that is not there": (lambda: read_manifest(Path("none")), BadConfig, "no such folder: none"),
    "open an unknown source": (
        lambda: open_source("cinema"),
        BadConfig,
        "the source must be one of open, bare, wide, everyday, candidates, hard, scape, mit, caesar, folder, labelled, "
        "paper, found 'cinema'",
    ),
    "open a source of files without its folder": (
        lambda: open_source("mit"),
        BadConfig,
        "the source 'mit' needs --path: the folder that holds I_crane and the other sequences",
    ),
    "open a source of files in no folder": (
        lambda: open_source("mit", Path("none")),
        BadConfig,
        "the source 'mit' reads a folder, found none at none",
    ),
    "open a source of made bodies in a folder": (
        lambda: open_source("open", Path("x")),
        BadConfig,
        "the source 'open' makes its bodies and reads no files: leave --path out",
    ),
    "open a source of made bodies for repair": (
        lambda: open_source("open", pymeshlab=True),
        BadConfig,
        "the source 'open' makes its bodies and reads no files: leave --pymeshlab out",
    ),
    "pack no mesh": (lambda: Packing("open", meshes=0), BadConfig, "Packing: meshes must be at least 1, found 0"),
    "pack empty shards": (
        lambda: Packing("open", shard_samples=0),
        BadConfig,
        "Packing: shard_samples must be at least 1, found 0",
    ),
    "pack with an unknown renderer": (
        lambda: open_renderer("povray", Mesh("m", POINTS, FACES)),
        BadConfig,
        "the renderer must be one of raster, embree, opengl, found 'povray'",
    ),
    "pack with an unknown codec": (
        lambda: encode_sample(NAME, "jpg"),
        BadConfig,
        "the codec must be one of bsi, png, found 'jpg'",
    ),
    "pack with an unknown distance": (
        lambda: nearest_sources(NAME, POINTS, FACES, np.array([0])),
        BadConfig,
        "the method for distances must be one of exact, unfolded, edges, found 'hot'",
    ),
    "pack on an unknown engine": (
        lambda: check_engine("dask"),
        BadConfig,
        "the engine must be processes or dask://HOST:PORT, found 'dask'",
    ),
    "reduce meshes by less than nothing": (
        lambda: Packing("open", tolerance_mm=-1.0),
        BadConfig,
        "Packing: tolerance_mm must be at least 0, found -1.0",
    ),
    "pack more meshes than there are": (
        lambda: Packing("open", meshes=3000).bodies(),
        BadConfig,
        "3000 meshes asked for, the source has 2329",
    ),
    "view from too near": (
        lambda: ViewGrid((20,)),
        BadConfig,
        "a view's distance must be between 50 and 600 cm, found [20]",
    ),
    "view from one distance twice": (
        lambda: ViewGrid((215, 215)),
        BadConfig,
        "each distance of views must be given once, found [215, 215]",
    ),
    "view in uneven steps": (
        lambda: ViewGrid(azimuths=7),
        BadConfig,
        "azimuths must divide 1 to 360 degrees evenly, found 7 in 180",
    ),
    "view more often than there are views": (
        lambda: ViewGrid(count=55),
        BadConfig,
        "views a mesh must be between 1 and 54, found 55",
    ),
    "name a sample with a dot": (
        lambda: check_key("a.b"),
        BadSample,
        "a sample key must be 1 to 80 letters, digits, '_', '+' or '-', found 'a.b'",
    ),
    "store a range beyond 16 bits": (
        lambda: steps(np.array([[7.0]]), 1e-4, "here"),
        BadSample,
        "here: a range must be 0 to 6.5535 m, 65535 steps of 0.1 mm, found 7 m",
    ),
    "decode no members": (
        lambda: decode_sample("k", {}),
        BadSample,
        "k: a sample has the members bsi, json or facing.png, json, labels.png, projector.png, range.png, found none",
    ),
    "decode surfaces of no class as a class": (
        lambda: decode_sample("k", {}, unlabelled=True),
        BadConfig,
        "unlabelled must be one of 254, 255, found True",
    ),
    "draw labels in colours from 0 to 1": (
        lambda: colour_labels(np.zeros((2, 2), np.uint8), colours=np.ones((33, 3))),
        BadConfig,
        "colours must be whole numbers from 0 to 255, found float64",
    ),
    "decode damaged images": (
        lambda: decode_sample("k", {"bsi": b"x", "json": b"{}"}),
        BadSample,
        "k: bsi: images have a header of 78 bytes, found 1 bytes in all",
    ),
    "add an unknown variant": (
        lambda: Augmentation(load_rig(), "snow"),
        BadConfig,
        "the variant must be one of none, occ, noise, md, all, occ+noise, occ+md, noise+md, found 'snow'",
    ),
    "add artifacts without a rig": (
        lambda: Augmentation(NONE, "all"),
        BadConfig,
        "Augmentation: rig must be of class Rig, found None",
    ),
    "add artifacts by a wrong seed": (
        lambda: Augmentation(load_rig(), "all", -1),
        BadConfig,
        "a seed must be a whole number from 0 to 9223372036854775807, found -1",
    ),
    "use an unknown rig": (
        lambda: load_rig("none"),
        BadConfig,
        "no rig is called 'none': give one of azure_kinect, kinect_v1, kinect_v2, orbbec_astra, orbbec_femto, paper, "
        "realsense_d435, realsense_d455 or the path of a .toml file",
    ),
    "read a rig that is not there": (
        lambda: load_rig(Path("none.toml")),
        BadConfig,
        "cannot read the rig file none.toml: No such file or directory",
    ),
    "use unknown landmarks": (
        lambda: load_landmarks("none"),
        BadLandmarks,
        "no landmark set is called 'none': give mit_I or open",
    ),
    "read a mesh that is not there": (
        lambda: read_mesh(Path("none.ply")),
        BadMesh,
        "cannot read none.ply: No such file or directory",
    ),
    "read a mesh of an unknown kind": (
        lambda: read_mesh(Path("body.step")),
        BadMesh,
        "a mesh file's name must end in .ply, .obj, .off, .ply.gz, .obj.gz, .off.gz, found body.step",
    ),
    "make a mesh of nothing": (
        lambda: Mesh("m", np.zeros((0, 3)), np.zeros((0, 3), int)),
        BadMesh,
        "mesh m: a mesh needs vertices and faces, found 0 and 0",
    ),
    "make a mesh of flat points": (
        lambda: Mesh("m", np.zeros((4, 2)), FACES),
        BadMesh,
        "mesh m: vertices and faces must have three columns, found (4, 2), (4, 3)",
    ),
    "make a mesh of broken numbers": (
        lambda: Mesh("m", np.full((4, 3), np.nan), FACES),
        BadMesh,
        "mesh m: coordinates must be finite, found [nan, nan, nan] at vertex 0",
    ),
    "make a mesh of other vertices": (
        lambda: Mesh("m", POINTS, FACES + 1),
        BadMesh,
        "mesh m: faces must use vertices 0 to 3, found [1, 2, 4] at face 1",
    ),
    "make a mesh of faces between numbers": (
        lambda: Mesh("m", POINTS, FACES * 1.0),
        BadMesh,
        "mesh m: faces must be whole numbers, found float64",
    ),
    "make a mesh in millimetres": (
        lambda: Mesh("m", POINTS * 1000, FACES),
        BadMesh,
        "mesh m: a body must be 0.5 to 2.5 m at its largest, found 1e+03 m",
    ),
    "make a mesh inside out": (
        lambda: Mesh("m", POINTS, FACES[:, ::-1]),
        BadMesh,
        "mesh m: faces must point outwards, found -0.167 m3 inside",
    ),
    "make a mesh with a face turned over": (
        lambda: Mesh("m", POINTS, np.concatenate([FACES[:1, ::-1], FACES[1:]])),
        BadMesh,
        "mesh m: neighbouring faces must agree, found a clash at [0, 1]",
    ),
    "open SCAPE's meshes in a folder without them": (
        lambda: ScapeBodies(Path("none")),
        BadConfig,
        "the source 'scape' needs mesh000.ply to mesh071.ply in its folder: found none in none",
    ),
    "put landmarks on a mesh of another topology": (
        lambda: LandmarkSet("here", "a ball", 643, 1280, tuple(range(33))).for_mesh(Mesh("m", POINTS, FACES)),
        BadLandmarks,
        "landmarks here are for meshes of 643 vertices and 1280 faces (a ball), found 4 and 4 in mesh m: "
        "this mesh needs landmarks of its own",
    ),
    "divide a mesh by too few landmarks": (
        lambda: partition(Mesh("m", POINTS, FACES), np.arange(32)),
        BadLandmarks,
        "mesh m: landmarks must be 33 whole numbers, found int64 (32,)",
    ),
    "build an unknown network": (
        lambda: build("unet"),
        BadConfig,
        "the network must be one of fcn_alexnet, compact, found 'unet'",
    ),
    "load a network from another kind of file": (
        lambda: load_network(Path("network.pth")),
        BadConfig,
        "a network is compact, large, finder, a run's folder or a .safetensors file, found network.pth, "
        "which is not there",
    ),
    "load pretrained weights of a network that has none": (
        lambda: build("compact").load_pretrained(Path("a.onnx")),
        BadConfig,
        "Compact starts from a run's folder or a .safetensors file, found a.onnx",
    ),
    "find bodies between limits in the wrong order": (
        lambda: Background("limits", 2, 2),
        BadConfig,
        "the near limit must be at least 0 m and less than the far one, found 2 and 2 m",
    ),
    "read frames in an unknown unit": (
        lambda: metres_a_step("inch"),
        BadConfig,
        "a unit must be a length from 0.001mm to 10cm, such as mm or 0.1mm; floating point needs none for metres: "
        "found 'inch'",
    ),
    "label frames of another size": (
        lambda: Segmenter(build("compact"), LENS)(np.zeros((80, 60), np.float32)),
        BadConfig,
        "a frame must have the camera's size, 60 x 80, found 80 x 60",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_an_error_is_this_line(case: str) -> None:
    provoke, kind, line = CASES[case]
    with pytest.raises(BodysegError) as caught:
        provoke()
    assert (type(caught.value), str(caught.value)) == (kind, line)


LOADER: dict[str, tuple[dict[str, Any], str]] = {
    "batch of nothing": ({"batch_size": 0}, "batch_size must be a whole number of at least 1, found 0"),
    "workers below zero": ({"num_workers": -1}, "LoaderOptions: num_workers must be at least 0, found -1"),
    "nothing ahead": ({"prefetch_factor": 0}, "LoaderOptions: prefetch_factor must be at least 1, found 0"),
    "no such start": (
        {"start_method": "thread"},
        "LoaderOptions: start_method must be 'fork' or 'spawn' or 'forkserver' or None, found 'thread'",
    ),
    "text for yes": ({"shuffle": "no"}, "shuffle must be True, False or 'blocks', found 'no'"),
    "rank alone": ({"rank": 1}, "rank and world_size are given together or not at all, found 1 of None"),
    "rank too high": ({"rank": 1, "world_size": 1}, "rank must be less than world_size, found 1 of 1"),
    "more ranks than samples": (
        {"rank": 0, "world_size": 25},
        "24 samples are fewer than 25 ranks: use fewer ranks",
    ),
    "uneven batches": (
        {"batch_size": 1, "rank": 0, "world_size": 7},
        "24 samples cannot be shared out to 7 ranks in equally many batches of 1: "
        "use a larger batch_size, or drop_last=True",
    ),
    "errors ignored": ({"on_error": "ignore"}, "on_error must be one of stop, skip, found 'ignore'"),
    "skipping without a budget": (
        {"on_error": "skip"},
        "on_error='skip' and a skip_budget belong together, found 'skip' and None",
    ),
    "a budget of more than all": (
        {"on_error": "skip", "skip_budget": 1.5},
        "skip_budget must be a number of samples, or a share below 1, found 1.5",
    ),
}


@pytest.mark.parametrize("case", LOADER)
def test_a_loaders_error_is_this_line(case: str, figures_set: Path) -> None:
    options, line = LOADER[case]
    with pytest.raises(BadConfig) as caught:
        loader(RangeImages(figures_set, "none"), **({"batch_size": 4} | options))
    assert str(caught.value) == line
