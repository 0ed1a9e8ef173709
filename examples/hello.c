/* SPDX-License-Identifier: MIT-0
   hello.c - one picture of a shape that lives in a neural network.   cc -O2 examples/hello.c -lm -o hello && ./hello */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "common.h"

enum { W = 512, H = 512 };
static float depth[W * H], normal[3 * W * H];
static unsigned char mask[W * H];

int main(int argc, char **argv)
{
    if (argc > 1) { fail("hello takes no arguments, got %s", argv[1]); }
    dist_context *ctx = dist_context_create(NULL);
    dist_net *net = load_embedded(ctx); /* or dist_net_load_file(ctx, "model.safetensors") */
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 0));
    dist_field field = dist_shape_field(shape);

    float eye[3] = {1.4f, 1.0f, 2.0f}, at[3] = {0.0f, 0.0f, 0.0f}, up[3] = {0.0f, 1.0f, 0.0f};
    dist_camera camera = dist_camera_look_at(W, H, 0.7f, eye, at, up);
    dist_images out = {.depth = depth, .normal = normal, .mask = mask};

    dist_render(ctx, &field, &camera, NULL, &out, NULL);
    dist_pfm_save(ctx, "hello.pfm", W, H, 1, depth);
    check(ctx); /* once is enough: the first failure stays, with its sentence */

    canvas picture = picture_shaded(W, H, normal, mask, NULL);
    printf("%s and hello.pfm written\n", write_canvas("hello", &picture));

    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
