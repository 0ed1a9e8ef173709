/* SPDX-License-Identifier: MIT-0
   bench_cache.c - what a cache of empty space saves: free rays and spheres against a field that stands still, without a
   cache and with ones of growing resolution. CSV on stdout; one thread.
     rays       of a camera's pixels, each by itself, as in picking; certified: with how.certified, and a cache
                made with the figures for that
     shadow     from each of their hits toward a light, any_hit; occlusion: eight into the half space over it, half a
                radius far
     spheres    of a fiftieth of the radius, all over the bounding sphere's cube, as dist_field_collide takes them
     nearest    points of some of these, as dist_field_closest_point takes them, all in one call; lone: a call each
   differ: those whose status is another than without a cache, or whose distance by more than 1e-4 of the radius. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"

static const char usage[] =
    "bench_cache [options]\n"
    "  --net MODEL        a file, or the word embedded (default)\n"
    "  --code N           its code (default 0)\n"
    "  --size N           pixels along a side of the camera (default 256)\n"
    "  --quick            128 pixels, two resolutions\n";

enum { RAYS, CERTIFIED, SHADOW, OCCLUSION, SPHERES, NEAREST, LONE, CASES };
enum { OVER = 8, NEAREST_POINTS = 4096, LONE_POINTS = 256 };
static const char *const names[CASES] = {"rays", "certified", "shadow", "occlusion", "spheres", "nearest", "lone"};

/* A field that counts what it is asked. */
typedef struct counted {
    dist_field field;
    unsigned long long queries;
} counted;

static void counted_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    counted *c = (counted *)user;
    c->queries += n;
    c->field.eval_fn(c->field.user, worker, n, points, sdf, gradient);
}

/* n rays or, with a radius behind each center, spheres; and what became of them without a cache. */
typedef struct batch {
    size_t n, hits;
    float *origins, *directions; /* of points, each on its own: (n, 3), and their distances */
    unsigned char *status;
    double seconds, queries;
} batch;

static batch batch_create(size_t n)
{
    batch b = {n, 0, take_floats(4 * n), take_floats(3 * n), (unsigned char *)take(n, 1), 0, 0};
    return b;
}

static void batch_destroy(batch *b)
{
    free(b->origins);
    free(b->directions);
    free(b->status);
}

/* Nearest points, once; returns as batch_run does. */
static size_t points_run(dist_context *ctx, const dist_field *field, int kind, batch *b, int first)
{
    size_t differ = 0, each = kind == LONE ? 1 : b->n;
    float *closest = take_floats(3 * b->n), *distance = take_floats(b->n);
    unsigned char *status = (unsigned char *)take(b->n, 1);
    for (size_t i = 0; i < b->n; i += each) {
        dist_field_closest_point(ctx, field, each, b->origins + 3 * i, closest + 3 * i, distance + i, status + i);
    }
    b->hits = 0;
    for (size_t i = 0; i < b->n; i++) {
        b->hits += status[i] == DIST_RAY_HIT;
        if (first) {
            b->status[i] = status[i];
            b->directions[i] = distance[i];
        }
        differ += status[i] != b->status[i] || fabsf(distance[i] - b->directions[i]) > 1e-4f * field->radius;
    }
    free(closest);
    free(distance);
    free(status);
    return differ;
}

/* Once; returns how many ended otherwise than without a cache. */
static size_t batch_run(dist_context *ctx, const dist_field *field, int kind, batch *b, int first, dist_hit *hits,
                        dist_contact *contacts)
{
    dist_render_desc how = {.certified = kind == CERTIFIED, .any_hit = kind == SHADOW || kind == OCCLUSION};
    size_t differ = 0;
    if (kind >= NEAREST) { return points_run(ctx, field, kind, b, first); }
    if (kind == OCCLUSION) { how.max_distance = 0.5f * field->radius; }
    if (kind == SPHERES) {
        dist_field_collide(ctx, field, b->n, b->origins, contacts);
    } else {
        dist_trace(ctx, field, b->n, b->origins, b->directions, &how, hits, NULL);
    }
    b->hits = 0;
    for (size_t i = 0; i < b->n; i++) {
        unsigned char status = (unsigned char)(kind == SPHERES ? contacts[i].status : hits[i].status);
        b->hits += status == DIST_RAY_HIT;
        differ += !first && status != b->status[i];
        if (first) { b->status[i] = status; }
    }
    return differ;
}

/* The hits of the camera's rays, a little above the surface, with the normals there. */
static size_t hits_of(dist_context *ctx, const dist_field *field, const batch *rays, const dist_hit *hits,
                      float *points, float *normals)
{
    size_t n = 0;
    float *sdf = take_floats(rays->n);
    for (size_t i = 0; i < rays->n; i++) {
        if (hits[i].status != DIST_RAY_HIT) { continue; }
        for (size_t k = 0; k < 3; k++) {
            points[3 * n + k] = rays->origins[3 * i + k] + hits[i].distance * rays->directions[3 * i + k];
        }
        n++;
    }
    dist_field_eval(ctx, field, n, points, sdf, normals);
    for (size_t i = 0; i < 3 * n; i++) { points[i] += 4e-3f * field->radius * normals[i]; }
    free(sdf);
    return n;
}

int main(int argc, char **argv)
{
    static const int resolutions[] = {0, 32, 64, 128, 256};
    static const float light[3] = {-0.5f, 0.8f, 0.4f};
    const char *model = "embedded";
    int code = 0, size = 256, count = 5, repeats = 3;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--net")) {
            model = option_text(&o);
        } else if (option_is(&o, "--code")) {
            code = option_int(&o, 0, 1000);
        } else if (option_is(&o, "--size")) {
            size = option_int(&o, 8, 2048);
        } else if (option_is(&o, "--quick")) {
            size = 128;
            count = 3;
            repeats = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
    dist_context_desc settings = {.workers = 1};
    dist_context *ctx = dist_context_create(&settings);
    dist_net *net = load_model(ctx, model);
    if (code > 0 && code >= dist_net_code_count(net)) {
        fail("--code %d: the model has %d", code, dist_net_code_count(net));
    }
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, code));
    counted c = {dist_shape_field(shape), 0};
    if (dist_context_status(ctx) == DIST_OK && !c.field.eval_fn) { fail("%s has no distance", model); }
    dist_field plain = c.field;
    plain.user = &c;
    plain.eval_fn = counted_eval;
    check(ctx);

    size_t pixels = (size_t)size * (size_t)size;
    batch batches[CASES];
    dist_hit *hits = (dist_hit *)take(OVER * pixels, sizeof *hits);
    dist_contact *contacts = (dist_contact *)take(pixels, sizeof *contacts);
    float *points = take_floats(3 * pixels), *normals = take_floats(3 * pixels);
    dist_camera camera = bench_camera(&plain, size, size);
    rng random = rng_begin(5);
    batches[RAYS] = batch_create(pixels);
    for (size_t i = 0; i < pixels; i++) {
        dist_camera_ray(&camera, (float)(i % (size_t)size), (float)(i / (size_t)size), batches[RAYS].origins + 3 * i,
                        batches[RAYS].directions + 3 * i);
    }
    batch_run(ctx, &plain, RAYS, &batches[RAYS], 1, hits, NULL);
    size_t lit = hits_of(ctx, &plain, &batches[RAYS], hits, points, normals);
    check(ctx);
    batches[CERTIFIED] = batch_create(pixels);
    memcpy(batches[CERTIFIED].origins, batches[RAYS].origins, 3 * pixels * sizeof(float));
    memcpy(batches[CERTIFIED].directions, batches[RAYS].directions, 3 * pixels * sizeof(float));
    batches[SHADOW] = batch_create(lit);
    batches[OCCLUSION] = batch_create(OVER * lit);
    for (size_t i = 0; i < OVER * lit; i++) {
        float d[3], square;
        do { /* on the unit sphere about the normal's end */
            square = 0;
            for (int k = 0; k < 3; k++) {
                d[k] = 2 * rng_uniform(&random) - 1;
                square += d[k] * d[k];
            }
        } while (square > 1 || square < 0.01f);
        for (size_t k = 0; k < 3; k++) {
            batches[OCCLUSION].origins[3 * i + k] = points[3 * (i / OVER) + k];
            batches[OCCLUSION].directions[3 * i + k] = normals[3 * (i / OVER) + k] + 0.98f * d[k] / sqrtf(square);
        }
        const float *way = batches[OCCLUSION].directions + 3 * i;
        float length = sqrtf(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
        for (size_t k = 0; k < 3; k++) { batches[OCCLUSION].directions[3 * i + k] /= length; }
    }
    memcpy(batches[SHADOW].origins, points, 3 * lit * sizeof(float));
    for (size_t i = 0; i < 3 * lit; i++) { batches[SHADOW].directions[i] = light[i % 3]; }
    batches[SPHERES] = batch_create(pixels);
    for (size_t i = 0; i < 4 * pixels; i++) {
        float at = i % 4 == 3 ? 0.02f : 2 * rng_uniform(&random) - 1;
        batches[SPHERES].origins[i] = plain.radius * at + (i % 4 == 3 ? 0.0f : plain.center[i % 4]);
    }
    for (int kind = NEAREST; kind < CASES; kind++) {
        size_t most = kind == LONE ? LONE_POINTS : NEAREST_POINTS, n = most < pixels ? most : pixels;
        batches[kind] = batch_create(n);
        for (size_t i = 0; i < n; i++) {
            memcpy(batches[kind].origins + 3 * i, batches[SPHERES].origins + 4 * i, 3 * sizeof(float));
        }
    }

    printf("case,resolution,count,hits,make_queries,make_seconds,queries,seconds,of_queries,of_seconds,differ\n");
    for (int r = 0; r < count; r++) {
        double start = seconds_now();
        dist_cache *cache = r > 0 ? dist_cache_create(ctx, &plain, resolutions[r]) : NULL;
        double made = seconds_now() - start;
        dist_field field = cache ? dist_cache_field(cache) : plain, sure = plain;
        sure.lipschitz = fmaxf(plain.lipschitz, plain.certified);
        sure.lipschitz_far = fmaxf(plain.lipschitz_far, plain.certified_far);
        start = seconds_now();
        dist_cache *sure_cache = r > 0 ? dist_cache_create(ctx, &sure, resolutions[r]) : NULL;
        double sure_made = seconds_now() - start;
        if (sure_cache) { sure = dist_cache_field(sure_cache); }
        check(ctx);
        for (int kind = 0; kind < CASES; kind++) {
            batch *b = &batches[kind];
            int proven = kind == CERTIFIED;
            double seconds[3], queries = 0;
            size_t differ = 0;
            for (int i = 0; i < repeats; i++) {
                c.queries = 0;
                start = seconds_now();
                differ = batch_run(ctx, proven ? &sure : &field, kind, b, r == 0, hits, contacts);
                seconds[i] = seconds_now() - start;
                queries = (double)c.queries;
                check(ctx);
            }
            double taken = median((size_t)repeats, seconds);
            if (r == 0) {
                b->seconds = taken;
                b->queries = queries;
            }
            printf("%s,%d,%lu,%lu,%llu,%.4f,%.0f,%.4f,%.3f,%.3f,%lu\n", names[kind], resolutions[r],
                   (unsigned long)b->n, (unsigned long)b->hits, dist_cache_queries(proven ? sure_cache : cache),
                   !cache ? 0.0 : proven ? sure_made : made, queries, taken, queries / b->queries, taken / b->seconds,
                   (unsigned long)differ);
            fflush(stdout);
        }
        dist_cache_destroy(cache);
        dist_cache_destroy(sure_cache);
    }
    for (int kind = 0; kind < CASES; kind++) { batch_destroy(&batches[kind]); }
    free(hits);
    free(contacts);
    free(points);
    free(normals);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
