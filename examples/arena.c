/* SPDX-License-Identifier: MIT-0
   arena.c - a picture and a fit in a fixed piece of static memory, the library built without malloc: what
   dist_workspace_bytes asks for is what is used, to the byte.   cc -O2 examples/arena.c -lm -o arena && ./arena */
#define DIST_NO_LIBC_ALLOC
#define DIST_NO_TRAIN /* no gradients for weights, which would want 4 MB more */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "model.h"
#include <stdio.h>

enum { W = 128, H = 128, CODE = 32, STEPS = 20, ARENA = 4 << 20 };
static unsigned char memory[ARENA + 63];
static float depth[W * H], d_depth[W * H], observed[W * H];
static unsigned char mask[W * H];

/* Hands out one piece after another from an address that is a multiple of 64; gives nothing back. */
typedef struct arena {
    unsigned char *base;
    size_t size, used;
} arena;

static void *arena_alloc(void *user, size_t bytes, size_t alignment)
{
    arena *a = (arena *)user;
    size_t whole = (bytes + 63) / 64 * 64;
    if (alignment > 64 || whole > a->size - a->used) { return NULL; }
    a->used += whole;
    return a->base + a->used - whole;
}

static void arena_free(void *user, void *pointer, size_t bytes)
{
    (void)user, (void)pointer, (void)bytes; /* all goes at once, when the arena is used again */
}

/* Where dist_workspace_bytes has no context yet that could keep a sentence. */
static void say(void *user, dist_status status, const char *message)
{
    (void)user;
    fprintf(stderr, "arena: %s (%d)\n", message, status);
}

int main(int argc, char **argv)
{
    if (argc > 1) {
        fprintf(stderr, "arena: takes no arguments, got %s\n", argv[1]);
        return 2;
    }
    arena a = {memory + (64 - (size_t)memory % 64) % 64, ARENA, 0};
    dist_context_desc settings = {.workers = 1, .allocator = {&a, arena_alloc, arena_free}, .logger = {NULL, say}};
    const float eye[3] = {1.4f, 1.0f, 2.0f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(W, H, 0.7f, eye, at, up);
    dist_workspace_desc use = {.context = &settings, .model = model_words, .model_size = model_bytes,
                               .camera = &camera};
    size_t bytes = dist_workspace_bytes(&use);
    printf("asked for: %lu bytes of %lu\n", (unsigned long)bytes, (unsigned long)a.size);
    if (bytes == 0 || bytes > a.size) { return 1; }

    a.used = 0; /* the table of contents that it read is of no more use */
    a.size = bytes;
    dist_context *ctx = dist_context_create(&settings);
    dist_net *net = dist_net_load(ctx, model_words, model_bytes);
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 0));
    dist_field field = dist_shape_field(shape);
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
    if (dist_context_status(ctx) != DIST_OK || dist_net_code_size(net) != CODE) { return 1; }
    printf("used:      %lu bytes\n", (unsigned long)a.used);

    dist_images target = {.depth = observed, .mask = mask}, out = {.depth = depth, .mask = mask};
    dist_images d_out = {.depth = d_depth};
    float code[CODE], d_code[CODE], first = 0, loss = 0;
    dist_gradients grads = {.code = d_code};
    dist_render(ctx, &field, &camera, NULL, &target, NULL);
    memcpy(code, dist_net_code(net, 1), sizeof code); /* another shape, to be pulled toward the first */
    for (int i = 0; i <= STEPS; i++) {
        memset(d_depth, 0, sizeof d_depth);
        memset(d_code, 0, sizeof d_code);
        dist_shape_set_code(shape, code);
        dist_render(ctx, &field, &camera, NULL, &out, tape);
        loss = dist_loss_depth(W * H, depth, observed, mask, 1.0f, d_depth);
        dist_render_backward(ctx, tape, &d_out, &grads);
        first = i ? first : loss;
        float square = 1e-30f;
        for (int j = 0; j < CODE; j++) { square += d_code[j] * d_code[j]; }
        for (int j = 0; j < CODE; j++) { code[j] -= 0.5f * loss / square * d_code[j]; }
    }
    int good = dist_context_status(ctx) == DIST_OK && a.used == bytes && loss < 0.5f * first;
    printf("a fit of %d steps in it: mean error of depth from %.4f to %.4f\n", STEPS, (double)first, (double)loss);
    printf("%s\n", good ? "nothing else was asked for" : dist_context_message(ctx));
    dist_tape_destroy(tape);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return good ? 0 : 1;
}
