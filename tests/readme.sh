#!/bin/sh
# What the README says to type: its C as it stands, compiled, linked and run on the embedded model.
. tests/script.sh

awk -v work="$work" '/^```c$/ { n++; next } /^```/ { inside = 0; next } n != last { inside = 1; last = n }
inside && n > 0 { print > (work "/" n ".txt") }' README.md

# 1 is what stands in a main, 2 a file with the implementation, 3 another file of the same program.
{
    cat <<'END'
#include <stdio.h>
#include <string.h>
#include "../../../dist.h"
enum { W = 64, H = 64 };
static float depth[W * H], normal[3 * W * H];
static unsigned char mask[W * H];
int fit(const char *model, float *code);
void fit_pose(dist_context *ctx, const dist_field *field, const float *observed, dist_camera *camera);
void export_mesh(dist_context *ctx, const dist_field *field, const char *path);
dist_field own_field(float axis[3]);
int main(void)
{
END
    sed -e '/^#/d' -e '/^dist_shape_destroy/d' -e 's|"model.safetensors"|"examples/model.safetensors"|' "$work/1.txt"
    cat <<'END'

    int hits = 0, bad = 0;
    for (int i = 0; i < W * H; i++) hits += mask[i];
    if (hits < 200) printf("hello: %d hits\n", hits), bad++;

    float axis[3] = {0.6f, 0.3f, 0.45f}, turn[3] = {0.05f, -0.08f, 0.04f}, shift[3] = {0.03f, 0.02f, -0.05f};
    dist_field own = own_field(axis);
    dist_camera start = camera;
    dist_camera_move(&start, turn, shift);
    dist_render(ctx, &own, &camera, NULL, &out, NULL);
    fit_pose(ctx, &own, depth, &start);
    float off = 0;
    for (int i = 0; i < 3; i++) off += (start.translation[i] - camera.translation[i]) *
                                       (start.translation[i] - camera.translation[i]);
    if (off > 0.01f * 0.01f) printf("fit_pose: off by the square root of %g\n", (double)off), bad++;

    export_mesh(ctx, &own, "build/script/readme/own.ply");
    dist_mesh *mesh = dist_mesh_load(ctx, "build/script/readme/own.ply");
    if (!mesh || mesh->triangle_count < 1000) printf("export_mesh: too few triangles\n"), bad++;
    dist_mesh_destroy(mesh);
    if (dist_context_status(ctx) != DIST_OK) bad++;

    float code[256] = {0};
    memcpy(code, dist_net_code(net, 0), sizeof(float) * (size_t)dist_net_code_size(net));
    if (fit("examples/model.safetensors", code) != DIST_OK) bad++;
    if (fit("no such file", code) != DIST_IO) bad++;
END
    grep '^dist_shape_destroy' "$work/1.txt"
    printf '    return bad;\n}\n'
} >"$work/main.c"
cp "$work/2.txt" "$work/fit.c"
cp "$work/3.txt" "$work/more.c"
if [ -s "$work/1.txt" ] && [ -s "$work/2.txt" ] && [ -s "$work/3.txt" ]; then
    flags="-I. -O1 -Wall -Wextra -Werror -Wno-missing-field-initializers"
    expect readme_compiles $CC $flags "$work/main.c" "$work/fit.c" "$work/more.c" -o "$work/readme" -lm &&
        expect readme_runs "$work/readme"
else
    not_ok readme_compiles "its blocks of C were not found"
fi

# The functions and files that it names are there.
missing=
for name in $(grep -o '`*dist_[a-z_]*(' README.md | tr -d '`(' | sort -u); do
    grep -q "$name(" dist.h || missing="$missing $name"
done
for name in $(grep -o '\(examples\|tests\|bench\)/[a-z_]*\.\(c\|h\|sh\|md\)' README.md | sort -u); do
    [ -f "$name" ] || missing="$missing $name"
done
if [ -z "$missing" ]; then ok readme_names_what_is_there; else not_ok readme_names_what_is_there "not found:$missing"; fi
