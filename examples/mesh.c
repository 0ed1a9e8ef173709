/* SPDX-License-Identifier: MIT-0
   mesh.c - a model's surface as triangles.   cc -O2 examples/mesh.c -lm -o mesh && ./mesh embedded --out shape.ply */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "common.h"

static const char usage[] =
    "mesh MODEL [options] --out FILE.ply|FILE.obj\n"
    "  MODEL              a safetensors file, or the word embedded\n"
    "  --code FILE|INDEX  which shape: a stored code (default 0), or numbers as text or .f32\n"
    "  --resolution N     cells along each side, 2 to 2048 (default 128)\n"
    "  --level L          the surface is where f = L (default 0)\n"
    "  --refine N         Newton steps that move the vertices onto the surface, 0 to 8 (default 0)\n"
    "  --normals          also a normal for each vertex\n"
    "  --threads N        threads to use at most (default all)\n";

int main(int argc, char **argv)
{
    const char *model = NULL;
    const char *code_text = NULL;
    const char *path = NULL;
    dist_context_desc settings = {0};
    dist_mesh_desc desc = {0};
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is_word(&o) && !model) {
            model = o.argv[o.index];
        } else if (option_is(&o, "--code")) {
            code_text = option_text(&o);
        } else if (option_is(&o, "--resolution")) {
            desc.resolution = option_int(&o, 2, 2048);
        } else if (option_is(&o, "--level")) {
            desc.level = (float)option_number(&o, -1e3, 1e3);
        } else if (option_is(&o, "--refine")) {
            desc.refine = option_int(&o, 0, 8);
        } else if (option_is(&o, "--normals")) {
            desc.normals = option_flag(&o);
        } else if (option_is(&o, "--threads")) {
            settings.workers = option_int(&o, 1, 1024);
        } else if (option_is(&o, "--out")) {
            path = option_text(&o);
        } else {
            option_unknown(&o);
        }
    }
    if (!model) { fail("which model? mesh MODEL --out FILE.ply; --help tells more"); }
    if (!path || !(path_ends_with(path, ".ply") || path_ends_with(path, ".PLY") || path_ends_with(path, ".obj") ||
                   path_ends_with(path, ".OBJ"))) {
        fail("--out FILE.ply or --out FILE.obj is needed%s%s", path ? ", got " : "", path ? path : "");
    }

    check_path(path);
    dist_context *ctx = dist_context_create(&settings);
    dist_net *net = load_model(ctx, model);
    float *code = choose_code(net, code_text);
    dist_shape *shape = dist_shape_create(ctx, net, code);
    dist_field field = dist_shape_field(shape);
    check(ctx);
    if (!field.eval_fn) { fail("%s has no distance among its channels, so there is no surface", model); }

    double start = seconds_now();
    dist_mesh *mesh = dist_mesh_extract(ctx, &field, &desc);
    double seconds = seconds_now() - start;
    check(ctx);
    dist_mesh_save(ctx, mesh, path);
    check(ctx);
    printf("%s: %.0f vertices, %.0f triangles, %.2f seconds\n", path, (double)mesh->vertex_count,
           (double)mesh->triangle_count, seconds);
    if (mesh->triangle_count == 0) { puts("no cell meets the surface: there is none, or it is finer than the cells"); }

    dist_mesh_destroy(mesh);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    free(code);
    return 0;
}
