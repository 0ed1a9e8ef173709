/* SPDX-License-Identifier: MIT-0
   small.c - the smallest whole use of dist.h, built by the script tests with all kinds of switches

   -DDIST_IMPLEMENTATION           one file for all
   -DSMALL_LIBRARY                 only the implementation
   -DSMALL_TWICE                   the header is included once more, in another order
   It takes no memory from the C library, so that DIST_NO_LIBC_ALLOC can be told from it. */
#if defined(SMALL_LIBRARY) && !defined(DIST_IMPLEMENTATION)
#define DIST_IMPLEMENTATION
#endif
#ifdef SMALL_TWICE
#ifdef DIST_IMPLEMENTATION
#undef DIST_IMPLEMENTATION
#include "../dist.h"
#define DIST_IMPLEMENTATION
#endif
#endif
#include "../dist.h"
#ifdef SMALL_TWICE
#include "../dist.h"
#endif

#ifndef SMALL_LIBRARY
#include <stdio.h>
#include <string.h>

typedef struct arena {
    size_t used;
    union {
        double alignment;
        unsigned char bytes[1 << 24];
    } memory;
} arena;

static arena small_arena;

static void *small_alloc(void *user, size_t bytes, size_t alignment)
{
    arena *a = (arena *)user;
    size_t address = (size_t)(a->memory.bytes + a->used);
    size_t skip = (alignment - (address & (alignment - 1))) & (alignment - 1);
    if (bytes > sizeof a->memory.bytes - a->used - skip) return NULL;
    void *p = a->memory.bytes + a->used + skip;
    a->used += skip + bytes;
    return p;
}

static void small_free(void *user, void *pointer, size_t bytes)
{
    (void)user;
    (void)pointer;
    (void)bytes;
}

int main(void)
{
    dist_context_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.allocator.user = &small_arena;
    desc.allocator.alloc_fn = small_alloc;
    desc.allocator.free_fn = small_free;
    dist_context *ctx = dist_context_create(&desc);
    const float ball[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(ball);
    const float eye[3] = {0, 0, 2}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(9, 9, 0.7f, eye, at, up);
    float depth[81];
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = depth;
    dist_render(ctx, &field, &camera, NULL, &out, NULL);
    int good = dist_context_status(ctx) == DIST_OK && depth[40] > 1.499f && depth[40] < 1.501f;
    printf("%s %s %s\n", dist_version(), good ? "good" : "bad", dist_context_message(ctx));
    dist_context_destroy(ctx);
    return !good;
}
#endif
