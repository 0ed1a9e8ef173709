#!/usr/bin/env python3
# SPDX-License-Identifier: MIT-0
"""A step of an optimization in PyTorch and in dist.h, on the same processor, in one run; a row for a GPU if there is one.

    make && python3 bench/pytorch.py --threads 2        CSV on stdout

The step is bench_step's: a picture (depth, silhouette) of a decoder whose code is a little off, the losses, the gradient
for the code, Adam. PyTorch runs the paper's tracer as its authors' code does (coarse to fine 4, 2, 1; 50 steps; alpha 1.5;
steps clamped to 0.1; rays that are done leave the batch), written here anew and to PyTorch's advantage: one sample a
pixel goes back instead of three or five, only pixels that a loss looks at do, weights take no gradient, weight norm is
folded beforehand. Methods:

    eager       the code goes in with every point, in pieces of 100,000 points, as in the authors' code
    folded      the code is folded into biases once a step, in pieces of the size that is fastest here
    compiled    folded, through torch.compile; left out, with a word on stderr, where that fails
    dist.h      bench_step's rows, cold and warm (build/bench_step must be there)

queries: points whose f was asked for to make the picture. times: seconds over those of dist.h's cold step with the same
threads. Only ReLU nets without encoding and norm are read: deepsdf_512 of the test data (DIST_DATA or ../shared/data) and
the embedded model."""
import argparse
import csv
import io
import json
import math
import os
import statistics
import struct
import subprocess
import sys
import time

torch = None  # imported by main, once the threads are known

EPSILON, CLAMP, ALPHA, STEPS = 5e-5, 0.1, 1.5, 50
CASES = {"deepsdf_512": (os.path.join(os.environ.get("DIST_DATA", "../shared/data"), "nets/deepsdf_512.safetensors"), 0),
         "embedded": ("examples/model.safetensors", 5)}


def read_net(path):
    """Weights and biases of a safetensors file, weight norm folded in, its codes and the layer with the skip."""
    with open(path, "rb") as file:
        size = struct.unpack("<Q", file.read(8))[0]
        head, body = json.loads(file.read(size)), bytearray(file.read())
    meta, tensors = head.pop("__metadata__", {}), {}
    for name, t in head.items():
        begin, end = t["data_offsets"]
        tensors[name.replace("module.", "")] = torch.frombuffer(body[begin:end], dtype=torch.float32).view(t["shape"])
    layers = []
    while f"lin{len(layers)}.bias" in tensors:
        name = f"lin{len(layers)}"
        if name + ".weight_v" in tensors:
            v = tensors[name + ".weight_v"]
            weight = tensors[name + ".weight_g"] * v / v.norm(dim=1, keepdim=True)
        else:
            weight = tensors[name + ".weight"]
        layers.append([weight, tensors[name + ".bias"]])
    return layers, tensors["codes"], int(meta["dist.skip"])


class Eager:
    """f(p) of [code, p], the code beside every point."""
    piece = 100000

    def __init__(self, net):
        self.layers, _, self.skip = net

    def set_code(self, code):
        self.code = code

    def points(self, p):
        whole = torch.cat([self.code.expand(len(p), -1), p], 1)
        x = whole
        for i, (weight, bias) in enumerate(self.layers):
            if i == self.skip:
                x = torch.cat([x, whole], 1)
            x = torch.nn.functional.linear(x, weight, bias)
            if i + 1 < len(self.layers):
                x = torch.relu(x)
        return torch.tanh(x[:, 0])

    def __call__(self, p):
        self.asked += len(p)
        if len(p) <= self.piece:
            return self.points(p)
        return torch.cat([self.points(part) for part in p.split(self.piece)])


class Folded(Eager):
    """The same with the code in the biases of the two layers that see it."""

    def set_code(self, code):
        self.folded = []
        width = len(code)
        for i, (weight, bias) in enumerate(self.layers):
            front = weight.shape[1] - width - 3  # columns for the last layer's units
            if i in (0, self.skip):
                bias = bias + weight[:, front:front + width] @ code
                weight = torch.cat([weight[:, :front], weight[:, front + width:]], 1)
            self.folded.append((weight, bias))

    def points(self, p):
        x = p[:, :0]
        for i, (weight, bias) in enumerate(self.folded):
            if i in (0, self.skip):
                x = torch.cat([x, p], 1)
            x = torch.nn.functional.linear(x, weight, bias)
            if i + 1 < len(self.folded):
                x = torch.relu(x)
        return torch.tanh(x[:, 0])


class Compiled(Folded):
    def __init__(self, net):
        super().__init__(net)
        self.points = torch.compile(super().points, dynamic=True)


class Picture:
    """The rays of bench.h's camera on every level: 2.2 radii away, azimuth 35 and elevation 25 degrees."""

    def __init__(self, size, device):
        azimuth, elevation = math.radians(35), math.radians(25)
        eye = 2.2 * torch.tensor([math.cos(elevation) * math.sin(azimuth), math.sin(elevation),
                                  math.cos(elevation) * math.cos(azimuth)], dtype=torch.float64)
        forward = -eye / eye.norm()
        right = torch.linalg.cross(forward, torch.tensor([0.0, 1, 0], dtype=torch.float64))
        right = right / right.norm()
        axes = torch.stack([right, torch.linalg.cross(forward, right), forward])
        self.size, self.eye, self.levels = size, eye.float().to(device), []
        for scale in (4, 2, 1):
            g = torch.arange(-(-size // scale), dtype=torch.float64) * scale + (scale - 1) / 2
            y, x = torch.meshgrid(g, g, indexing="ij")
            focal = 385.0 * size / 512
            d = torch.stack([(x - (size - 1) / 2) / focal, (y - (size - 1) / 2) / focal, torch.ones_like(x)], 2)
            z = 1 / d.norm(dim=2)
            d = (d * z[..., None]) @ axes
            b = d @ eye
            gap = eye @ eye - b * b  # squared distance of the line to the center
            meets = (gap <= 1) & (b < 0)
            half = (1 - gap).clamp(min=0).sqrt()
            self.levels.append([a.to(device) for a in (d.float(), (-b - half).float(), (-b + half).float(), meets,
                                                       z.float())])


def trace(f, picture):
    """hit (n), sample of smallest |f| (n, 3), its f, and the distance and depth per unit of it, of the rays that meet."""
    eye, t, best, where, parent = picture.eye, None, None, None, None
    fine = picture.levels[2][3]
    for level, (d, enter, leave, _, z) in enumerate(picture.levels):
        scale = 4 >> level
        mask = torch.nn.functional.max_pool2d(fine[None, None].float(), scale, scale, ceil_mode=True)[0, 0] > 0
        ids = torch.full(mask.shape, -1, dtype=torch.long, device=d.device)
        ids[mask] = torch.arange(int(mask.sum()), device=d.device)
        d, leave, z, start = d[mask], leave[mask], z[mask], enter[mask]
        if parent is None:
            t = start.clone()
            best, where = torch.full_like(t, math.inf), t.clone()
        else:
            y, x = mask.nonzero(as_tuple=True)
            from_ = parent[y // 2, x // 2]
            t, best, where = t[from_], best[from_], where[from_]
        parent = ids
        if level < 2:
            for _ in range(3):
                s = f(eye + t[:, None] * d)
                closer = s.abs() < best.abs()
                best, where = torch.where(closer, s, best), torch.where(closer, t, where)
                t = t + ALPHA * s.clamp(-CLAMP, CLAMP)
            continue
        own = torch.full_like(t, math.inf)  # the hit is one of the finest level's
        live = torch.arange(len(t), device=t.device)
        for _ in range(STEPS - 6):
            if len(live) == 0:
                break
            at = t[live]
            s = f(eye + at[:, None] * d[live])
            closer = s.abs() < best[live].abs()
            near = live[closer]
            best[near], where[near] = s[closer], at[closer]
            own[live] = torch.minimum(own[live], s.abs())
            at = at + ALPHA * s.clamp(-CLAMP, CLAMP)
            t[live] = at
            live = live[(at < leave[live]) & (s.abs() >= EPSILON)]
        hit = (t < leave) & (own <= EPSILON)
        return hit, eye + where[:, None] * d, best, where, z


def synchronize(device):
    if device == "cuda":
        torch.cuda.synchronize()


def fastest_piece(f, device):
    """The size of a piece that evaluates 100,000 points fastest."""
    p = torch.rand(100000, 3, device=device) - 0.5
    best = None
    with torch.no_grad():
        for piece in (1000, 4000, 16000, 100000):
            f.piece = piece
            f(p)
            for _ in range(3):
                synchronize(device)
                start = time.perf_counter()
                f(p)
                synchronize(device)
                taken = time.perf_counter() - start
                if best is None or taken < best[0]:
                    best = taken, piece
    f.piece = best[1]


def run(kind, net, code_index, size, steps, device):
    """Medians of a step's seconds, its forward and backward part, the picture's queries, and its hits."""
    layers, codes, skip = net
    net = [[a.to(device) for a in layer] for layer in layers], codes, skip
    picture = Picture(size, device)
    f = kind(net)
    f.asked = 0
    target_code = codes[code_index].to(device)
    f.set_code(target_code)
    if kind is not Eager:
        fastest_piece(f, device)
    with torch.no_grad():
        target_hit, _, s, t, z = trace(f, picture)
    target = z * (t + s)
    torch.manual_seed(1)
    spread = float(target_code.pow(2).mean().sqrt())
    code = (target_code + 0.05 * spread * (2 * torch.rand_like(target_code) - 1)).requires_grad_(True)
    adam = torch.optim.Adam([code], lr=1e-3)
    rows = []
    for i in range(steps + 1):
        synchronize(device)
        start = time.perf_counter()
        f.asked = 0
        f.set_code(code)
        with torch.no_grad():
            hit, p, s, t, z = trace(f, picture)
        asked = f.asked
        synchronize(device)
        middle = time.perf_counter()
        both, missing, extra = hit & target_hit, target_hit & ~hit, hit & ~target_hit
        looked_at = target_hit | hit
        value = torch.zeros_like(s).masked_scatter(looked_at, f(p[looked_at]))
        depth = z * (t + s + ALPHA * (value - value.detach()))
        loss = 10 * (depth - target)[both].abs().mean() + code.pow(2).mean()
        for wrong, side in ((missing, 1), (extra, -1)):
            if wrong.any():
                loss = loss + (side * (value[wrong] - EPSILON)).clamp(min=0).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        synchronize(device)
        end = time.perf_counter()
        if i > 0:  # the first is not counted
            rows.append((end - start, middle - start, end - middle, asked, int(hit.sum())))
    return [statistics.median(column) for column in zip(*rows)]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", choices=CASES, help="only this one")
    parser.add_argument("--size", type=int, default=512, help="pixels along a side (default 512)")
    parser.add_argument("--steps", type=int, default=5, help="measured steps (default 5)")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parser.add_argument("--threads", type=int, default=cores,
                        help="for both (default: as many as the process may use)")
    parser.add_argument("--no-compile", action="store_true", help="without the compiled row")
    parser.add_argument("--no-gpu", action="store_true", help="without the GPU's rows")
    o = parser.parse_args()
    os.environ.pop("OPENBLAS_CORETYPE", None)  # in virtual machines OpenBLAS may take a processor of long ago for this one
    if os.path.exists("/proc/cpuinfo") and "avx512f" in open("/proc/cpuinfo", encoding="utf-8").read():
        os.environ["OPENBLAS_CORETYPE"] = "SKYLAKEX"
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(o.threads)
    global torch
    import torch
    torch.set_num_threads(o.threads)
    out = csv.writer(sys.stdout, lineterminator="\n")
    print(f"# PyTorch {torch.__version__}, {o.threads} threads"
          + (f"; {torch.cuda.get_device_name()}" if torch.cuda.is_available() and not o.no_gpu else ""))
    out.writerow("case,method,device,resolution,threads,seconds,forward,backward,queries,hits,times".split(","))
    for name, (path, code) in CASES.items():
        if o.case not in (None, name):
            continue
        if not os.path.exists(path):
            print(f"skip {name}: {path} is not there", file=sys.stderr)
            continue
        done = subprocess.run(["build/bench_step", "--case", name, "--size", str(o.size), "--steps", str(o.steps),
                               "--threads", str(o.threads)], stdout=subprocess.PIPE, text=True, check=True).stdout
        ours = list(csv.DictReader(io.StringIO(done)))
        cold = float(ours[0]["seconds"])
        for r in ours:
            out.writerow([name, "dist.h " + r["mode"], "cpu", o.size, o.threads, f"{float(r['seconds']):.4f}",
                          f"{float(r['render']):.4f}", f"{float(r['backward']):.4f}", r["queries"], r["hits"],
                          f"{float(r['seconds']) / cold:.2f}"])
        net = read_net(path)
        kinds = [("eager", Eager), ("folded", Folded)] + ([] if o.no_compile else [("compiled", Compiled)])
        for device in ["cpu"] + (["cuda"] if torch.cuda.is_available() and not o.no_gpu else []):
            for label, kind in kinds:
                try:
                    seconds, forward, backward, queries, hits = run(kind, net, code, o.size, o.steps, device)
                except Exception as error:  # whatever torch.compile cannot do here
                    if kind is not Compiled:
                        raise
                    print(f"skip {name}, compiled, {device}: {str(error).splitlines()[0]}", file=sys.stderr)
                    continue
                out.writerow([name, "PyTorch " + label, device, o.size, o.threads, f"{seconds:.4f}", f"{forward:.4f}",
                              f"{backward:.4f}", f"{queries:.0f}", f"{hits:.0f}", f"{seconds / cold:.2f}"])
                sys.stdout.flush()


if __name__ == "__main__":
    main()
