/* SPDX-License-Identifier: MIT-0
   The table of hard cases, ../shared/stability.md, row by row: each test is named after its row and prints, with
   DIST_TORTURE set (make torture), row,case,expected,got. DIST_TEST_ISA chooses the instruction set; both tracers run
   where a row is about both. What a row needs in breadth (every mutation of a file, every size of a kernel) stands in
   the test of that section; here is the case itself. */
#include "model.h"
#include "shapes.h"

#include <fenv.h>
#ifndef FE_UPWARD /* WebAssembly rounds to nearest only */
#define FE_UPWARD FE_TONEAREST
#define FE_DOWNWARD FE_TONEAREST
#define FE_TOWARDZERO FE_TONEAREST
#endif
#if defined(__SSE__)
#include <xmmintrin.h>
#endif

enum { SIDE = 64, PIXELS = SIDE * SIDE };

static const double pi = 3.14159265358979323846;
static int row_now;

/* One line of the table; expected is text, got a number. */
static void say(int good, const char *what, const char *expected, double got)
{
    if (getenv("DIST_TORTURE"))
        printf("%d,\"%s\",\"%s\",%.6g%s\n", row_now, what, expected, got, good ? "" : " (wrong)");
    if (!test_check(good, what, __FILE__, __LINE__))
        printf("    row %d: expected %s, got %.9g\n", row_now, expected, got);
}
#define SAY(good, what, expected, got) say((good) ? 1 : 0, what, expected, (double)(got))

typedef shape_picture picture;

static picture a, b;

static dist_images images(picture *p)
{
    memset(p, 0, sizeof *p);
    return shape_planes(p);
}

static dist_status draw(dist_context *ctx, test_shape *shape, double radius, double lipschitz,
                        const dist_camera *camera, const dist_render_desc *how, picture *p)
{
    dist_field field = shape_field(shape, radius, lipschitz);
    dist_images out = images(p);
    return dist_render(ctx, &field, camera, how, &out, NULL);
}

static dist_render_desc defaults(int trace)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.trace = trace;
    return how;
}

static float bits_of(uint32_t bits)
{
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

static int all_finite(size_t n, const float *x)
{
    for (size_t i = 0; i < n; i++)
        if (!test_finite((double)x[i])) return 0;
    return 1;
}

static int finite_picture(const picture *p)
{
    return all_finite(PIXELS, p->depth) && all_finite(PIXELS, p->distance) && all_finite(PIXELS, p->error) &&
           all_finite(PIXELS, p->silhouette) && all_finite(3 * PIXELS, p->normal);
}

static dist_hit shoot(dist_context *ctx, test_shape *shape, double lipschitz, const float o[3], const float d[3],
                      const dist_render_desc *how)
{
    dist_hit hit;
    memset(&hit, 0, sizeof hit);
    shape->queries = 0;
    dist_field field = shape_field(shape, 1, lipschitz);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, o, d, how, &hit, NULL), ctx);
    return hit;
}

/* Pixels that surely cross and are neither hit nor unresolved; hits of rays that stay clear; hits off by more than the
   bound. */
typedef struct verdict {
    int crossing, missed, phantom, broken, hits, judged;
} verdict;

static verdict judge(const test_shape *shape, const dist_camera *camera, double step, const picture *p, double epsilon)
{
    verdict v;
    memset(&v, 0, sizeof v);
    for (int i = 0; i < camera->width * camera->height; i++) {
        double o[3], d[3], t0, t1;
        shape_pixel(camera, i % camera->width, i / camera->width, o, d);
        v.hits += p->mask[i];
        if (!shape_enter(o, d, 1, &t0, &t1)) {
            v.phantom += p->mask[i];
            continue;
        }
        shape_crossing c = shape_cross(shape, o, d, t0, t1, 1, step, epsilon);
        if (c.crosses && c.below > 2e-6) {
            v.crossing++;
            v.missed += !p->mask[i] && p->status[i] != DIST_RAY_UNRESOLVED;
        } else if (!c.crosses && c.least > 1.5 * epsilon) {
            v.phantom += p->mask[i];
        }
        if (!p->mask[i] || !c.crosses || c.touched) continue;
        v.judged++;
        v.broken += fabs((double)p->distance[i] - c.t) > (double)p->error[i] + 1e-6 + 6e-8 / fmax(fabs(c.slope), 1e-3);
    }
    return v;
}

/* A net of 3 x 24 whose weights are multiplied by `scale`, with a tanh at its end from 10 on; at 0 its last bias is
   `last`. NULL on failure. */
static dist_shape *plain_net(dist_context *ctx, dist_net **net, int activation, int code, double scale, double last)
{
    static float w[20000];
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 3;
    desc.width = 24;
    desc.code_size = code;
    desc.activation = activation;
    desc.output_linear = scale < 10;
    desc.geometric = activation == DIST_ACTIVATION_RELU;
    desc.seed = 5;
    *net = dist_net_create(ctx, &desc);
    size_t n = dist_net_weight_count(*net);
    if (!*net || n > 20000) return NULL;
    memcpy(w, dist_net_weights(*net), n * sizeof *w);
    for (size_t i = 0; i < n; i++) w[i] = (float)((double)w[i] * scale);
    if (scale <= 0) w[n - 1] = (float)last; /* the last bias */
    if (dist_net_set_weights(ctx, *net, w) != DIST_OK) return NULL;
    return dist_shape_create(ctx, *net, NULL);
}

enum { PULL_ALL, PULL_HITS };

/* Renders a field and pulls on every plane, or on what only hits have; the gradients of code (8) and camera (6). */
static dist_status pull_on(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                           const dist_render_desc *how, int what, picture *p, float g[14])
{
    static float ones[3 * PIXELS];
    dist_images out = images(p), d_out;
    dist_gradients grads;
    dist_tape *tape = dist_tape_create(ctx, camera, how);
    for (int i = 0; i < 3 * PIXELS; i++) ones[i] = i % 2 ? 1.0f : -0.5f;
    memset(g, 0, 14 * sizeof *g);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    d_out.depth = d_out.normal = ones;
    if (what == PULL_ALL) d_out.silhouette = ones;
    d_out.stats = &p->stats;
    grads.code = field->code_size > 0 && field->code_size <= 8 ? g : NULL;
    grads.rotation = g + 8;
    grads.translation = g + 11;
    if (!tape) return DIST_OUT_OF_MEMORY;
    dist_status status = dist_render(ctx, field, camera, how, &out, tape);
    if (status == DIST_OK) status = dist_render_backward(ctx, tape, &d_out, &grads);
    dist_tape_destroy(tape);
    return status;
}

/* ---- 1 to 10: single rays ---------------------------------------------------------------------------------------- */

/* A plane met at an angle, far enough away that neither the sphere nor the clamp matters. */
TEST(row_01_grazing_rays)
{
    dist_context *ctx = shape_context();
    const double degrees[8] = {90, 45, 20, 10, 5, 1, 0.5, 0.1};
    dist_camera camera = shape_pinhole();
    for (int k = 0; k < 8; k++) {
        for (int trace = 0; trace < 2; trace++) {
            double angle = degrees[k] * pi / 180;
            test_shape plane = shape_make(SHAPE_PLANE, 0, cos(angle), -sin(angle), -0.0015);
            dist_render_desc how = defaults(trace);
            CHECK_STATUS(DIST_OK, draw(ctx, &plane, 1, 1, &camera, &how, &a), ctx);
            double expected = 0.0015 / sin(angle); /* 0.86 at 0.1 degrees */
            int good = a.status[0] == DIST_RAY_UNRESOLVED ||
                       (a.status[0] == DIST_RAY_HIT &&
                        fabs((double)a.distance[0] - expected) <=
                            (trace ? 1e-4 / sin(angle) : (double)a.error[0] + 2e-7 / sin(angle)));
            SAY(good, trace ? "plane, paper: distance" : "plane, guarded: distance", "hit in bound or unresolved",
                a.distance[0]);
        }
    }
    const int rows[2] = {DIST_PAPER_DYNAMIC, DIST_PAPER_AGGRESSIVE}, steps[2] = {52, 33};
    for (int k = 0; k < 2; k++) {
        double angle = 10 * pi / 180;
        test_shape plane = shape_make(SHAPE_PLANE, 0, cos(angle), -sin(angle), -1);
        dist_render_desc how = defaults(DIST_TRACE_PAPER);
        how.paper_row = rows[k];
        how.max_steps = 100;
        how.epsilon = 5e-5f;
        CHECK_STATUS(DIST_OK, draw(ctx, &plane, 12, 1, &camera, &how, &a), ctx);
        SAY(a.mask[0] && a.stats.march_queries == (unsigned)steps[k] + 1, "paper's steps at 10 degrees",
            k ? "33" : "52", (double)a.stats.march_queries - 1);
    }
    dist_context_destroy(ctx);
}

TEST(row_02_steep_slopes)
{
    dist_context *ctx = shape_context();
    const double slopes[6] = {1.2, 1.33, 2, 5, 100, 1000};
    static float notes[4 * SHAPE_NOTES];
    int crossed = 0, over = 0;
    long most = 0;
    for (int k = 0; k < 6; k++) {
        test_random r = test_random_seed(3);
        for (int j = 0; j < 200; j++) {
            test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
            float o[3], d[3];
            test_random_direction(&r, o);
            for (int i = 0; i < 3; i++) {
                o[i] *= 2.0f;
                d[i] = test_random_float(&r, -0.7f, 0.7f) - o[i];
            }
            shape.slope = slopes[k];
            shape.clamp = 0.1;
            shape.notes = notes;
            dist_hit hit = shoot(ctx, &shape, 1, o, d, NULL);
            long at = 0;
            while (at < shape.queries && notes[4 * at + 3] > 0) at++;
            if (at >= shape.queries) continue;
            crossed++;
            over += shape.queries - at - 1 > 12;
            most = shape.queries - at - 1 > most ? shape.queries - at - 1 : most;
            CHECK_EQUAL(DIST_RAY_HIT, hit.status);
        }
        dist_camera camera = shape_pinhole();
        test_shape plane = shape_make(SHAPE_PLANE, 0, 0, -1, -0.7213);
        dist_render_desc how = defaults(DIST_TRACE_PAPER);
        plane.slope = slopes[k];
        how.paper_row = DIST_PAPER_AGGRESSIVE;
        CHECK_STATUS(DIST_OK, draw(ctx, &plane, 1, slopes[k], &camera, &how, &a), ctx);
        SAY(a.status[0] == (slopes[k] < 1.3                ? DIST_RAY_HIT
                            : a.status[0] == DIST_RAY_MISS ? DIST_RAY_MISS
                                                           : DIST_RAY_UNRESOLVED),
            "paper's status", slopes[k] < 1.3 ? "1 hit" : "2 unresolved or 0 past the exit", a.status[0]);
    }
    SAY(over * 50 <= crossed && crossed > 300, "rays with more than 12 queries once crossed", "at most 2 %",
        100.0 * over / crossed);
    SAY(most <= 12, "most queries of a ray once crossed", "12", most);
    dist_context_destroy(ctx);
}

TEST(row_03_small_slopes)
{
    dist_context *ctx = shape_context();
    const double slopes[3] = {0.1, 0.05, 0.01};
    for (int k = 0; k < 3; k++) {
        int wrong = 0;
        for (int j = 0; j < 40; j++) {
            test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
            shape.slope = slopes[k];
            float o[3] = {0, 0, 2.5f}, d[3] = {0.005f * (float)j, 0, -1};
            dist_hit hit = shoot(ctx, &shape, 1, o, d, NULL);
            double length = shape_length((double)d[0], 0, 1), off = 2.5 * (double)d[0] / length;
            double expected = 2.5 / length - sqrt(0.36 - off * off);
            if (hit.status == DIST_RAY_UNRESOLVED) continue;
            wrong += hit.status != DIST_RAY_HIT ||
                     fabs(expected - (double)hit.distance) > (double)hit.error + 2e-6 + 1e-7 / slopes[k];
        }
        SAY(wrong == 0, "neither within the bound nor reported", "0", wrong);
        dist_camera camera = shape_camera(SIDE, SIDE);
        test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
        shape.slope = slopes[k];
        for (int trace = 0; trace < 2; trace++) {
            dist_render_desc how = defaults(trace);
            how.paper_row = DIST_PAPER_AGGRESSIVE;
            CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
            verdict v = judge(&shape, &camera, 1e-4, &a, 1e-4 / slopes[k]);
            SAY(v.crossing > 100 && v.missed == 0 && (trace || v.broken == 0),
                trace ? "picture, paper: silently background" : "picture, guarded: background or beyond the bound", "0",
                v.missed + v.broken * !trace);
        }
    }
    dist_context_destroy(ctx);
}

TEST(row_04_plateaus)
{
    dist_context *ctx = shape_context();
    const double values[3] = {0.3, 2.5e-5, 0};
    const int expected[3] = {DIST_RAY_MISS, DIST_RAY_PLATEAU, DIST_RAY_PLATEAU};
    for (int k = 0; k < 3; k++) {
        test_shape shape = shape_make(SHAPE_CONSTANT, values[k], 0, 0, 0);
        float o[3] = {0.1f, 0.2f, 2.5f}, d[3] = {0, 0, -1};
        dist_hit hit = shoot(ctx, &shape, 1, o, d, NULL);
        SAY(hit.status == expected[k] && shape.queries <= 100, "status of a constant field", k ? "4 plateau" : "0 miss",
            hit.status);
        dist_camera camera = shape_camera(SIDE, SIDE);
        int other = 0;
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, NULL, &a), ctx);
        for (int i = 0; i < PIXELS; i++) {
            double p[3], v[3], t0, t1;
            shape_pixel(&camera, i % SIDE, i / SIDE, p, v);
            if (shape_enter(p, v, 0.99, &t0, &t1)) other += a.status[i] != expected[k];
        }
        SAY(other == 0 && a.stats.queries <= 100 * PIXELS, "pixels of another status", "0", other);
        camera = shape_camera(8, 8);
        for (int row = 0; row < 4; row++) {
            dist_render_desc how = defaults(DIST_TRACE_PAPER);
            how.paper_row = row;
            CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
            SAY(a.stats.queries <= 64 * 50, "paper's queries", "at most 50 a ray", (double)a.stats.queries / 64);
        }
    }
    dist_context_destroy(ctx);
}

TEST(row_05_clamped_field)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    const double clamps[3] = {0.1, 0.05, 0.02};
    for (int k = 0; k < 3; k++) {
        test_shape shape = shape_make(SHAPE_RODS, 0.0224865, 0, 0, 0);
        shape.clamp = clamps[k];
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, NULL, &a), ctx);
        verdict v = judge(&shape, &camera, 1e-4, &a, 1e-4);
        SAY(v.missed == 0 && v.phantom == 0, "rods: missed or false hits", "0", v.missed + v.phantom);
        for (int i = 0; i < PIXELS; i++) {
            const float *n = a.normal + 3 * i;
            double length = shape_length((double)n[0], (double)n[1], (double)n[2]);
            if (fabs(length - a.mask[i]) > 1e-5) CHECK_NEAR(a.mask[i], length, 1e-5);
        }
        SAY((double)a.stats.march_queries / PIXELS < 3 / clamps[k], "queries a ray", "steps stay useful",
            (double)a.stats.queries / PIXELS);
        for (int trace = 0; trace < 2; trace++) {
            dist_render_desc how = defaults(trace);
            float g[14];
            dist_field field = shape_field(&shape, 1, 1);
            how.gradient = DIST_GRADIENT_IMPLICIT;
            shape.clamped = shape.gradients = 0;
            CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_HITS, &a, g), ctx);
            SAY(shape.clamped == 0 && shape.gradients > 50, "normals and gradients taken where f is clamped", "0",
                shape.clamped);
        }
    }
    dist_context_destroy(ctx);
}

TEST(row_06_saturated_tanh)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(32, 32);
    test_shape shape = shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0);
    shape.squash = 200;
    CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 20, &camera, NULL, &a), ctx);
    verdict v = judge(&shape, &camera, 1e-4, &a, 1e-4);
    SAY(v.missed == 0 && v.phantom == 0 && finite_picture(&a), "missed or false hits, f = 1 to the last bit", "0",
        v.missed + v.phantom);
    for (int trace = 0; trace < 2; trace++) { /* a net whose tanh is +-1 to the last bit but beside its surface */
        dist_net *net = NULL;
        dist_shape *net_shape = plain_net(ctx, &net, DIST_ACTIVATION_RELU, 2, 100, 0);
        dist_field field = dist_shape_field(net_shape);
        dist_render_desc how = defaults(trace);
        float g[14], p[3] = {0.9f, 0, 0}, f = 0;
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, 1, p, &f, NULL), ctx);
        CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_ALL, &a, g), ctx);
        SAY(fabs((double)f) >= 1 && finite_picture(&a) && all_finite(14, g), "net: planes and gradients", "finite",
            g[0]);
        dist_shape_destroy(net_shape);
        dist_net_destroy(net);
    }
    dist_context_destroy(ctx);
}

TEST(row_07_camera_inside_the_sphere)
{
    dist_context *ctx = shape_context();
    test_random r = test_random_seed(3);
    int wrong = 0, before = 0;
    static float notes[4 * SHAPE_NOTES];
    for (int k = 0; k < 100; k++) {
        test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
        float o[3] = {0, test_random_float(&r, 0.25f, 0.7f), 0}, d[3];
        double from[3] = {0, (double)o[1], 0}, v[3], t0 = 0, t1 = 0;
        test_random_direction(&r, d);
        for (int i = 0; i < 3; i++) v[i] = (double)d[i];
        shape.notes = notes;
        dist_hit hit = shoot(ctx, &shape, 1, o, d, NULL);
        shape_enter(from, v, 1, &t0, &t1);
        for (long i = 0; i < shape.queries; i++) {
            double t = 0;
            for (int j = 0; j < 3; j++) t += ((double)notes[4 * i + j] - from[j]) * v[j];
            before += t < -1e-6 || t > t1 + 1e-6;
        }
        shape_crossing c = shape_cross(&shape, from, v, t0, t1, 1, 1e-4, 1e-4);
        if (c.touched || (c.crosses && c.below < 1e-6) || (!c.crosses && c.least < 1e-4)) continue;
        wrong += hit.status != (c.crosses ? DIST_RAY_HIT : DIST_RAY_MISS);
    }
    SAY(wrong == 0, "other than in double", "0", wrong);
    for (int trace = 0; trace < 2; trace++) {
        test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
        float eye[3] = {0, 0.5f, 0.1f}, at[3] = {0.3f, 0, -0.2f}, up[3] = {0, 1, 0};
        dist_camera camera = dist_camera_look_at(16, 16, 1.4f, eye, at, up);
        dist_render_desc how = defaults(trace);
        how.paper_row = DIST_PAPER_DYNAMIC; /* its coarse rays march before they look at the exit */
        shape.notes = notes;
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
        verdict v = judge(&shape, &camera, 1e-4, &a, 1e-4);
        for (long i = 0; i < shape.queries && i < SHAPE_NOTES; i++) {
            double away[3], ahead = 0;
            for (int j = 0; j < 3; j++) {
                away[j] = (double)notes[4 * i + j] - (double)eye[j];
                ahead += away[j] * (double)camera.rotation[6 + j];
            }
            before += ahead < -1e-6 || shape_length((double)notes[4 * i], (double)notes[4 * i + 1],
                                                    (double)notes[4 * i + 2]) > 1 + 1e-5;
        }
        SAY(v.missed == 0 && v.phantom == 0 && v.crossing > 100, "picture: missed or false hits", "0",
            v.missed + v.phantom);
    }
    SAY(before == 0, "queries behind the camera or beyond the exit", "0", before);
    dist_context_destroy(ctx);
}

TEST(row_08_camera_inside_the_solid)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0);
    const float o[3] = {0.1f, 0.2f, -0.1f}, d[3] = {0, 0, 1};
    const double exit = 0.1 + sqrt(0.49 - 0.05);
    for (int mode = 0; mode < 3; mode++) {
        dist_render_desc how = defaults(DIST_TRACE_GUARDED);
        how.inside = mode;
        dist_hit hit = shoot(ctx, &shape, 1, o, d, &how);
        double expected = mode == DIST_INSIDE_EXIT ? exit : 0;
        SAY(hit.status == (mode == DIST_INSIDE_EXIT ? DIST_RAY_HIT : DIST_RAY_INSIDE) &&
                fabs(expected - (double)hit.distance) <= (double)hit.error + 1e-6,
            "distance", mode == DIST_INSIDE_EXIT ? "the exit" : "0 and status inside", hit.distance);
    }
    for (int k = 0; k < 9; k++) { /* guarded, paper's coarse-to-fine, aggressive */
        float from[3] = {0.1f, 0.2f, -0.1f}, to[3] = {0.4f, 0, 1}, over[3] = {0, 1, 0};
        dist_camera within = dist_camera_look_at(16, 16, 0.9f, from, to, over);
        dist_render_desc how = defaults(k / 3 > 0);
        how.paper_row = k / 6;
        how.inside = k % 3;
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &within, &how, &a), ctx);
        int out = k == DIST_INSIDE_EXIT; /* the paper's tracer has no way out */
        unsigned long long marked = out ? a.stats.hits : a.stats.inside;
        SAY(marked == 256 && a.mask[7] == (k % 3 == DIST_INSIDE_HIT || out) && (out || fabsf(a.distance[7]) < 1e-6f),
            out ? "pixels that exit" : "pixels with status inside", "256", marked);
    }
    /* found by random scenes: what was noted outside counted as a bracket on the way out */
    test_shape plane = shape_make(SHAPE_PLANE, 0.905468, 0, 0.424414, 0.311267);
    dist_render_desc how = defaults(DIST_TRACE_GUARDED);
    float eye[3] = {-0.2f, 0.3f, 0.1f}, at[3] = {1, 0, 0.2f}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(SIDE, SIDE, 1.6f, eye, at, up);
    plane.slope = 0.258994;
    how.inside = DIST_INSIDE_EXIT;
    CHECK_STATUS(DIST_OK, draw(ctx, &plane, 1, 0.13, &camera, &how, &a), ctx);
    double worst = 0;
    for (int i = 0; i < PIXELS; i++) {
        double p[3], v[3];
        shape_pixel(&camera, i % SIDE, i / SIDE, p, v);
        if (a.mask[i]) worst = fmax(worst, fabs(shape_along(&plane, p, v, (double)a.distance[i])) - (double)a.error[i]);
    }
    SAY(a.stats.hits > 100 && worst < 3e-4, "exit of a plane, figure too small: |f| at hits", "0", worst);
    dist_context_destroy(ctx);
}

TEST(row_09_camera_on_the_surface_and_tangents)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    const float exact[3] = {0, 0, 0.5f}, up[3] = {0, 0, 1}, along[3] = {1, 0, 0}, down[3] = {0, 0, -1};
    const float on[3] = {0, 0, 1}, off[3] = {-3, 0, 1};
    SAY(shoot(ctx, &shape, 1, exact, up, NULL).status == DIST_RAY_MISS && shape.queries <= 60,
        "leaving the surface: queries", "at most 60", shape.queries);
    SAY(shoot(ctx, &shape, 1, exact, along, NULL).status == DIST_RAY_MISS && shape.queries <= 60, "along it: queries",
        "at most 60", shape.queries);
    SAY(fabs((double)shoot(ctx, &shape, 1, exact, down, NULL).distance) < 1e-4, "into it: queries", "hit at 0",
        shape.queries);
    SAY(shoot(ctx, &shape, 1, on, down, NULL).status == DIST_RAY_HIT, "from the bounding sphere: queries", "hit",
        shape.queries);
    SAY(shoot(ctx, &shape, 1, off, along, NULL).status == DIST_RAY_MISS && shape.queries <= 1, "tangent: queries",
        "at most 1", shape.queries);
    for (int k = 0; k < 4; k++) { /* from the surface, from the bounding sphere */
        float from[3] = {0, 0, k / 2 ? 1.0f : 0.5f}, to[3] = {0.2f, 0, 2}, over[3] = {0, 1, 0};
        dist_camera there = dist_camera_look_at(16, 16, 0.9f, from, to, over);
        dist_render_desc how = defaults(k % 2);
        how.paper_row = DIST_PAPER_DYNAMIC; /* coarse-to-fine calls |f| < epsilon there a hit: the authors' rule */
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &there, &how, &a), ctx);
        SAY(finite_picture(&a) && a.stats.hits == 0 && a.stats.queries <= 60 * 256, "picture that leaves: hits", "0",
            a.stats.hits);
    }
    dist_context_destroy(ctx);
}

TEST(row_10_object_behind)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    float eye[3] = {0, 0, 2}, at[3] = {0, 0, 4}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(16, 16, 0.8f, eye, at, up);
    for (int trace = 0; trace < 2; trace++) {
        dist_render_desc how = defaults(trace);
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
        SAY(a.stats.queries == 0 && a.stats.hits == 0, "queries", "0", a.stats.queries);
    }
    dist_context_destroy(ctx);
}

/* ---- 11 to 21: pictures ------------------------------------------------------------------------------------------ */

TEST(row_11_far_cameras)
{
    dist_context *ctx = shape_context();
    const double away[3] = {1e2, 1e4, 1e6};
    test_shape shape = shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0);
    for (int k = 0; k < 3; k++) {
        float eye[3] = {0, 0, (float)away[k]}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
        dist_camera camera = dist_camera_look_at(SIDE, SIDE, (float)(2.2 / away[k]), eye, at, up);
        for (int trace = 0; trace < 2; trace++) {
            int wrong = 0;
            double worst = 0;
            dist_render_desc how = defaults(trace);
            how.paper_row = DIST_PAPER_PARALLEL;
            CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
            for (int i = 0; i < PIXELS; i++) {
                double o[3], d[3], along = 0;
                shape_pixel(&camera, i % SIDE, i / SIDE, o, d);
                for (int j = 0; j < 3; j++) along -= o[j] * d[j];
                double q = shape_length(o[0] + along * d[0], o[1] + along * d[1], o[2] + along * d[2]);
                if (fabs(q - 0.7) < 3e-3) continue;
                wrong += a.mask[i] != (q < 0.7) && a.status[i] != DIST_RAY_UNRESOLVED;
                if (a.mask[i] && q < 0.6 && !trace)
                    worst = fmax(worst, fabs(along - sqrt(0.49 - q * q) - (double)a.distance[i]) - (double)a.error[i] -
                                            6e-8 * away[k]);
            }
            SAY(wrong == 0, "pixels other than in double", "0", wrong);
            if (!trace) SAY(worst < 2e-6, "distance off beyond the bound and float", "2e-6", worst);
        }
    }
    dist_context_destroy(ctx);
}

TEST(row_12_world_scale)
{
    dist_context *ctx = shape_context();
    const double scales[2] = {1e-6, 1e6};
    const float one[5] = {0, 0, 0, 0.6f, 0.2f};
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int trace = 0; trace < 2; trace++) {
        dist_render_desc how = defaults(trace);
        dist_images out = images(&a);
        dist_field field = dist_field_torus(one);
        how.paper_row = DIST_PAPER_AGGRESSIVE;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        for (int k = 0; k < 2; k++) {
            float scaled[5] = {0, 0, 0, (float)(0.6 * scales[k]), (float)(0.2 * scales[k])};
            dist_camera moved = camera;
            int masks = 0;
            double worst = 0;
            for (int i = 0; i < 3; i++) moved.translation[i] *= (float)scales[k];
            field = dist_field_torus(scaled);
            if (trace) how.epsilon = (float)(5e-5 * scales[k]);
            out = images(&b);
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &moved, &how, &out, NULL), ctx);
            for (int i = 0; i < PIXELS; i++) {
                masks += a.mask[i] != b.mask[i];
                if (a.mask[i] && b.mask[i])
                    worst = fmax(worst, fabs((double)a.distance[i] - (double)b.distance[i] / scales[k]));
            }
            SAY(masks <= 2, "pixels of the mask", "at most 2 that touch", masks);
            SAY(worst < 1e-5, "distance", "1e-5", worst);
        }
    }
    dist_context_destroy(ctx);
}

TEST(row_13_focal_lengths)
{
    dist_context *ctx = shape_context();
    const float focal[4] = {1e-3f, 1, 1e3f, 1e6f};
    for (int k = 0; k < 4; k++) {
        for (int trace = 0; trace < 2; trace++) {
            dist_camera camera = shape_camera(SIDE, SIDE);
            dist_render_desc how = defaults(trace);
            test_shape shape = shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0);
            float o[3], d[3];
            camera.fx = camera.fy = focal[k];
            dist_camera_ray(&camera, 3, 5, o, d);
            SAY(fabs(shape_length((double)d[0], (double)d[1], (double)d[2]) - 1) < 1e-6, "length of a direction", "1",
                shape_length((double)d[0], (double)d[1], (double)d[2]));
            CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
            SAY(finite_picture(&a), "a picture without NaN", "1", finite_picture(&a));
        }
    }
    dist_context_destroy(ctx);
}

TEST(row_14_tiny_epsilon)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    const float epsilons[3] = {0, 1e-12f, 5e-8f};
    for (int k = 0; k < 3; k++) {
        test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
        dist_render_desc how = defaults(DIST_TRACE_GUARDED);
        how.epsilon = epsilons[k];
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
        verdict v = judge(&shape, &camera, 1e-4, &a, 1e-4);
        SAY(v.missed == 0, "eroded pixels", "0", v.missed);
        SAY(a.stats.epsilon >= 1e-7f && a.stats.epsilon <= 1e-4f, "epsilon in force", "above the noise",
            a.stats.epsilon);
        how.trace = DIST_TRACE_PAPER;
        how.paper_row = DIST_PAPER_DYNAMIC;
        how.max_steps = 100;
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
        v = judge(&shape, &camera, 1e-4, &a, 1e-4);
        SAY(v.missed == 0 && a.stats.epsilon >= 1e-7f, "paper: pixels silently eroded", "0", v.missed);
    }
    dist_context_destroy(ctx);
}

TEST(row_15_large_epsilon)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    for (int trace = 0; trace < 2; trace++) {
        dist_render_desc how = defaults(trace);
        how.epsilon = 5e-2f;
        how.paper_row = DIST_PAPER_DYNAMIC;
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
        double most = 0;
        for (int i = 0; i < PIXELS; i++) {
            double o[3], d[3], along = 0;
            shape_pixel(&camera, i % SIDE, i / SIDE, o, d);
            for (int k = 0; k < 3; k++) along -= o[k] * d[k];
            double off = shape_length(o[0] + along * d[0], o[1] + along * d[1], o[2] + along * d[2]);
            if (a.mask[i]) most = fmax(most, off - 0.5);
            if (off < 0.4999) CHECK_EQUAL(1, a.mask[i]);
        }
        SAY(most < 0.0501, "dilation", "at most 0.05", most);
    }
    dist_context_destroy(ctx);
}

TEST(row_16_step_scale)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    const float good[5] = {1, 1.5f, 1.99f, 2, 2.5f};
    const float bad[3] = {-1, bits_of(0x7fc00000u), bits_of(0x7f800000u)};
    test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    dist_render_desc how = defaults(DIST_TRACE_GUARDED);
    for (int k = 0; k < 5; k++) {
        how.step_scale = good[k];
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
        verdict v = judge(&shape, &camera, 1e-4, &a, 1e-4);
        SAY(v.missed == 0 && v.phantom == 0, "missed or false hits", "0", v.missed + v.phantom);
    }
    for (int k = 0; k < 6; k++) {
        dist_context_clear(ctx);
        how = defaults(k / 3);
        how.step_scale = bad[k % 3];
        dist_status status = draw(ctx, &shape, 1, 1, &camera, &how, &a);
        SAY(status == DIST_BAD_ARGUMENT && strstr(dist_context_message(ctx), "step_scale"), "status",
            "-1 and a sentence", status);
    }
    dist_context_destroy(ctx);
}

TEST(row_17_plates_and_rods)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int k = 0; k < 8; k++) {
        double thin = pow(10, -1 - k % 5);
        test_shape shape = k < 5 ? shape_make(SHAPE_BOX, 0.6, 0.5, 0.5 * thin, 0)
                                 : shape_make(SHAPE_RODS,
                                              k == 5   ? 5e-3
                                              : k == 6 ? 1e-3
                                                       : 1e-4,
                                              0, 0, 0);
        for (int trace = 0; trace < 2; trace++) {
            dist_render_desc how = defaults(trace);
            how.paper_row = DIST_PAPER_AGGRESSIVE;
            CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
            verdict v = judge(&shape, &camera, fmin(1e-4, 0.1 * thin), &a, 1e-4);
            if (trace)
                SAY(1, k < 5 ? "plate, paper's misses (% of rays that cross)" : "rod, paper's misses (%)", "printed",
                    100.0 * v.missed / fmax(v.crossing, 1));
            else
                SAY(v.missed == 0 && v.phantom == 0, k < 5 ? "plate, guarded: missed" : "rod, guarded: missed", "0",
                    v.missed);
        }
    }
    /* found by random scenes: within an epsilon larger than the part, or than the clamp, certified rays strode on */
    const double tubes[4] = {0.03, 0.03, 0.005, 0.03}, clamps[4] = {0, 0, 0, 0.013};
    const float epsilons[4] = {0.11f, 0.01f, 2e-3f, 0.06f};
    for (int k = 0; k < 8; k++) {
        test_shape shape = shape_make(SHAPE_TORUS, 0.6, tubes[k % 4], 0, 0);
        dist_render_desc how = defaults(DIST_TRACE_GUARDED);
        shape.clamp = clamps[k % 4];
        how.certified = 1;
        how.no_cones = k / 4;
        how.epsilon = epsilons[k % 4];
        CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
        verdict v = judge(&shape, &camera, 1e-4, &a, 1e-4);
        SAY(v.missed == 0 && v.crossing > 20, "thin torus, certified, epsilon large: missed", "0", v.missed);
    }
    dist_context_destroy(ctx);
}

TEST(row_18_nearest_of_two_surfaces)
{
    dist_context *ctx = shape_context();
    const double thick[4] = {1e-1, 1e-3, 1e-5, 6e-8}, gaps[3] = {0.1, 1e-4, 6e-8};
    int wrong = 0;
    for (int k = 0; k < 12; k++) {
        for (int j = 0; j < 20; j++) {
            test_shape pair = shape_make(SHAPE_PAIR, thick[k % 4], gaps[k / 4], 0, 0);
            float d[3] = {0.02f * (float)j, -0.03f, -1};
            float o[3] = {0.05f * (float)j - 0.5f - 2 * d[0], 0.1f - 2 * d[1], 2.0f + 0.013f * (float)j};
            dist_hit hit = shoot(ctx, &pair, 1, o, d, NULL);
            double length = shape_length((double)d[0], (double)d[1], 1);
            wrong += hit.status != DIST_RAY_HIT ||
                     fabs((double)o[2] * length - (double)hit.distance) >
                         (double)hit.error + 2e-6 + (thick[k % 4] < 1e-4 ? 5.1e-5 * length : 0);
        }
    }
    SAY(wrong == 0, "plates: not the nearest", "0", wrong);
    wrong = 0;
    for (int j = 0; j < 20; j++) {
        test_shape shells = shape_make(SHAPE_SHELLS, 1e-4, 0, 0, 0);
        float o[3] = {0, 0, 2}, d[3] = {0.017f * (float)j, 0, -1};
        dist_hit hit = shoot(ctx, &shells, 1, o, d, NULL);
        double size = shape_length((double)d[0], 0, 1), off = 2 * (double)d[0] / size, outer = 0.7 + 5e-5;
        wrong += hit.status != DIST_RAY_HIT ||
                 fabs(2 / size - sqrt(outer * outer - off * off) - (double)hit.distance) > (double)hit.error + 2e-6;
    }
    SAY(wrong == 0, "shells: not the nearest", "0", wrong);
    /* found by random scenes: a march that begins within a large epsilon of the sphere */
    dist_camera camera = shape_camera(SIDE, SIDE);
    test_shape shells = shape_make(SHAPE_SHELLS, 0.000957386, 0, 0, 0);
    dist_render_desc how = defaults(DIST_TRACE_GUARDED);
    shells.slope = 0.340712;
    how.epsilon = 0.105407f;
    CHECK_STATUS(DIST_OK, draw(ctx, &shells, 1, 1.54378, &camera, &how, &a), ctx);
    verdict v = judge(&shells, &camera, 1e-4, &a, 0.11 / 0.34);
    SAY(v.missed == 0, "shells, epsilon a tenth of the radius: missed", "0", v.missed);
    dist_context_destroy(ctx);
}

TEST(row_19_bumps)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_BUMPY, 0.6, 0.1, 80, 0);
    dist_camera camera = shape_camera(SIDE, SIDE);
    CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, NULL, &a), ctx);
    int hits = 0, far = 0;
    for (int i = 0; i < PIXELS; i++) {
        double o[3], d[3];
        shape_pixel(&camera, i % SIDE, i / SIDE, o, d);
        if (!a.mask[i]) continue;
        hits++;
        double t = (double)a.distance[i], e = (double)a.error[i] + 1e-6;
        far += !(shape_along(&shape, o, d, t - e) * shape_along(&shape, o, d, t + e) <= 0 ||
                 fabs(shape_along(&shape, o, d, t)) < 6e-5);
    }
    SAY(hits > 500 && far * 1000 <= hits, "hits at no crossing", "at most 0.1 %", 100.0 * far / fmax(hits, 1));
    SAY(a.stats.queries < PIXELS * 40, "queries a ray: no oscillation", "below 40", (double)a.stats.queries / PIXELS);
    dist_context_destroy(ctx);
}

TEST(row_20_dead_network)
{
    const double values[3] = {0.5, -0.5, 0};
    const int expected[6] = {DIST_RAY_MISS, DIST_RAY_INSIDE, DIST_RAY_PLATEAU,
                             DIST_RAY_MISS, DIST_RAY_INSIDE, DIST_RAY_UNRESOLVED};
    dist_context *ctx = test_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int k = 0; k < 6; k++) {
        dist_net *net = NULL;
        dist_shape *shape = plain_net(ctx, &net, DIST_ACTIVATION_RELU, 2, 0, values[k % 3]);
        dist_field field = dist_shape_field(shape);
        dist_render_desc how = defaults(k / 3);
        float g[14];
        int other = 0;
        how.paper_row = DIST_PAPER_PARALLEL; /* the others' coarse rays do not look at the exit */
        CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_ALL, &a, g), ctx);
        for (int i = 0; i < PIXELS; i++) {
            double o[3], d[3], t0, t1;
            shape_pixel(&camera, i % SIDE, i / SIDE, o, d);
            if (shape_enter(o, d, 0.999, &t0, &t1)) other += a.status[i] != expected[k];
        }
        SAY(other == 0, "rays of another status", "0", other);
        SAY(fabs((double)g[0]) <= 0 && fabs((double)g[1]) <= 0, "gradient of the code", "exactly 0", g[0]);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    dist_context_destroy(ctx);
}

TEST(row_21_sine_networks)
{
    const double omegas[2] = {30, 300};
    dist_context *ctx = test_context();
    for (int k = 0; k < 2; k++) {
        model_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.name = "sine";
        desc.activation = DIST_ACTIVATION_SINE;
        desc.first_scale = omegas[k];
        desc.scale = 30;
        desc.output = MODEL_NONE;
        model m = model_make(&desc, 3);
        dist_net *net = model_load(ctx, &m);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        dist_field field = dist_shape_field(shape);
        test_random r = test_random_seed(2);
        double worst = 0;
        for (int j = 0; j < 200; j++) {
            float p[3], f = 0;
            test_random_fill(&r, 3, p, -1, 1);
            double q[3] = {(double)p[0], (double)p[1], (double)p[2]};
            CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, 1, p, &f, NULL), ctx);
            worst = fmax(worst, fabs((double)f - model_eval(&m, m.params, m.codes, q)));
        }
        SAY(worst < 2e-7 * omegas[k] * 30, "f against double, omega 30 and 300", "float rounding of the angle", worst);
        worst = 0;
        for (int j = 0; j < 20000; j++) {
            float x = test_random_float(&r, -20, 20), slope = 0;
            double angle = omegas[k] * (double)x, exact = sin(angle);
            double ulp = ldexp(1, ilogb(fmax(fabs(exact), 1e-30)) - 23);
            double got = (double)inside_activate(DIST_ACTIVATION_SINE, (float)omegas[k], x, &slope);
            worst = fmax(worst, fabs(got - exact) / ulp);
            exact = omegas[k] * cos(angle);
            ulp = ldexp(1, ilogb(fmax(fabs(exact), 1e-30)) - 23);
            worst = fmax(worst, fabs((double)slope - exact) / ulp);
        }
        SAY(worst <= 4, "own sine and its slope, angles to 20 omega: ulp", "at most 4", worst);
        worst = 0;
        for (int j = -20000; j < 20000; j++) { /* where sine or slope is largest, and far out */
            float x = (float)(1.57079632679489661923 * (double)j / omegas[k]), slope = 0;
            for (int far = 0; far < 2; far++, x *= 1e4f) {
                double v = (double)inside_activate(DIST_ACTIVATION_SINE, (float)omegas[k], x, &slope);
                worst = fmax(worst, fmax(fabs(v), fabs((double)slope) / omegas[k]));
            }
        }
        SAY(worst <= 1, "largest |sine| and |slope| / omega", "1", worst);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        model_free(&m);
    }
    double worst = 0;
    for (float x = -40; x <= 40; x += 0.01f) { /* saturated either way, softplus bends as exp(-|2 x|) does */
        float slope = 0, v = inside_activate(DIST_ACTIVATION_SOFTPLUS, 2, x, &slope);
        double e = exp(-2 * fabs((double)x)), exact = 2 * e / (1 + e) / (1 + e);
        worst = fmax(worst, fabs((double)inside_curvature(DIST_ACTIVATION_SOFTPLUS, 2, v, slope) / exact - 1));
    }
    SAY(worst <= 2e-5, "softplus'' to 40 and -40, relative", "2e-5", worst);
    dist_context_destroy(ctx);
}

/* ---- 22 to 30: what comes in ------------------------------------------------------------------------------------- */

TEST(row_22_nan_and_infinity)
{
    const uint32_t bits[2] = {0x7fc00000u, 0x7f800000u};
    dist_context *ctx = shape_context();
    for (int k = 0; k < 2; k++) {
        float bad = bits_of(bits[k]), w[20000], code[2] = {0, bad}, loss, target[4] = {1, bad, 1, 1},
              depth[4] = {1, 1, 1, 1}, d[4] = {0};
        dist_net *net = NULL;
        dist_shape *shape = plain_net(ctx, &net, DIST_ACTIVATION_RELU, 2, 1, 0);
        size_t n = dist_net_weight_count(net);
        memcpy(w, dist_net_weights(net), n * sizeof *w);
        for (int bias = 0; bias < 2; bias++) {
            float kept = w[bias ? n - 1 : 7];
            w[bias ? n - 1 : 7] = bad;
            SAY(dist_net_set_weights(ctx, net, w) == DIST_NOT_FINITE, bias ? "bias: status" : "weight: status", "-5",
                dist_context_status(ctx));
            w[bias ? n - 1 : 7] = kept;
        }
        SAY(dist_shape_set_code(shape, code) == DIST_NOT_FINITE, "code: status", "-5", dist_context_status(ctx));
        test_shape ball = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
        dist_camera camera = shape_camera(SIDE, SIDE);
        camera.translation[1] = bad;
        SAY(draw(ctx, &ball, 1, 1, &camera, NULL, &a) != DIST_OK, "pose: status", "refused", dist_context_status(ctx));
        camera = shape_camera(SIDE, SIDE);
        camera.fx = bad;
        SAY(draw(ctx, &ball, 1, 1, &camera, NULL, &a) != DIST_OK, "intrinsic: status", "refused",
            dist_context_status(ctx));
        loss = dist_loss_depth(4, depth, target, NULL, 1, d);
        SAY(test_finite((double)loss) && all_finite(4, d) && fabs((double)d[1]) <= 0, "target: loss",
            "finite, pixel left out", loss);
        dist_context_clear(ctx);
        camera = shape_camera(SIDE, SIDE);
        for (int trace = 0; trace < 2; trace++) {
            dist_render_desc how = defaults(trace);
            float g[14];
            ball.poison = 0.2;
            dist_field field = shape_field(&ball, 1, 1);
            CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_ALL, &a, g), ctx);
            SAY(finite_picture(&a) && all_finite(14, g), "field: planes and gradients", "finite", finite_picture(&a));
            unsigned counted = 0;
            int hit = 0;
            for (int i = 0; i < PIXELS; i++) {
                counted += a.status[i] == DIST_RAY_NOT_FINITE;
                hit += a.status[i] == DIST_RAY_NOT_FINITE && a.mask[i];
            }
            SAY(counted > 0 && a.stats.not_finite == counted && hit == 0 && a.stats.hits > 100,
                "field: rays not finite", "counted, none a hit, others hit", a.stats.not_finite);
            ball.poison = 0;
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    dist_context_destroy(ctx);
}

/* wrong: 0 right, 1 A as if not transposed, 2 nothing written, 3 NaN */
static void wrong_sgemm(void *user, int transpose_a, int transpose_b, int m, int n, int k, float alpha, const float *x,
                        int ldx, const float *y, int ldy, float beta, float *z, int ldz)
{
    int wrong = *(int *)user;
    for (int i = 0; i < m && wrong != 2; i++)
        for (int j = 0; j < n; j++) {
            double sum = 0;
            for (int l = 0; l < k; l++)
                sum += (double)(transpose_a && wrong != 1 ? x[l * ldx + i] : x[i * ldx + l]) *
                       (double)(transpose_b ? y[j * ldy + l] : y[l * ldy + j]);
            float old = beta > 0 || beta < 0 ? beta * z[i * ldz + j] : 0;
            z[i * ldz + j] = wrong == 3 ? bits_of(0x7fc00000u) : (float)((double)alpha * sum) + old;
        }
}

/* infinity less infinity where x > 0.1, which no layer after it makes an ordinary number */
static dist_net *overflowing_net(dist_context *ctx)
{
    enum { WIDTH = 40 };
    static float w[4 * WIDTH + 2 * (WIDTH + 1) * WIDTH + WIDTH + 1];
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 3;
    desc.width = WIDTH;
    desc.output_linear = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    memset(w, 0, sizeof w);
    float *first = w, *second = first + 4 * WIDTH, *third = second + (WIDTH + 1) * WIDTH;
    float *last = third + (WIDTH + 1) * WIDTH;
    first[0] = 1e3f;               /* x */
    first[1 * 3 + 1] = 1;          /* y */
    first[2 * 3 + 1] = -1;         /* -y */
    second[0] = second[WIDTH] = 3e38f;
    second[2 * WIDTH + 1] = second[3 * WIDTH + 2] = 1;
    third[0] = 1, third[1] = -1;   /* NaN, else 0 */
    third[WIDTH + 2] = third[WIDTH + 3] = 1; /* |y| */
    last[0] = last[1] = 1;
    last[WIDTH] = -0.3f;
    CHECK_EQUAL(sizeof w / sizeof *w, dist_net_weight_count(net));
    CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, w), ctx);
    return net;
}

TEST(row_22_nan_inside_a_net)
{
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
    SKIP("-ffinite-math-only");
#else
    enum { N = 150 };
    dist_context *ctx = shape_context();
    dist_net *net = overflowing_net(ctx);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    test_random r = test_random_seed(22);
    static const int counts[6] = {1, 5, 12, 13, 48, N};
    static float p[3 * N], f[N], slope[3 * N], d_f[N], d_weights[4000];
    for (int i = 0; i < N; i++) {
        for (int k = 0; k < 3; k++) p[3 * i + k] = test_random_float(&r, -0.5f, 0.5f);
        p[3 * i] += p[3 * i] > 0 ? 0.1f : -0.1f;
        d_f[i] = 1;
    }
    for (int k = 0; k < 12; k++) {
        int n = counts[k / 2], wrong = 0;
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, (size_t)n, p, f, k % 2 ? slope : NULL), ctx);
        for (int i = 0; i < n; i++)
            wrong += p[3 * i] > 0 ? test_finite((double)f[i]) : !(fabsf(f[i] - (fabsf(p[3 * i + 1]) - 0.3f)) < 1e-6f);
        SAY(wrong == 0, "overflow: wrong values", "NaN there, right elsewhere", wrong);
    }
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.weights = d_weights;
    CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &field, N, p, d_f, NULL, NULL, NULL, &grads), ctx);
    double expected = 0;
    for (int i = 0; i < N; i++) expected += p[3 * i] < 0;
    SAY(all_finite((size_t)field.weight_count, d_weights) &&
            fabs((double)d_weights[field.weight_count - 1] - expected) < 1e-3,
        "overflow: weights' gradient", "of the others", d_weights[field.weight_count - 1]);
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int trace = 0; trace < 2; trace++) {
        dist_render_desc how = defaults(trace);
        float g[14];
        int hits = 0;
        CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_ALL, &a, g), ctx);
        for (int i = 0; i < PIXELS; i++) hits += a.status[i] == DIST_RAY_HIT;
        SAY(finite_picture(&a) && all_finite(14, g) && hits > 20 && a.stats.not_finite > 100,
            "overflow: picture and gradients", "finite, rays counted", a.stats.not_finite);
    }
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    for (int activation = 0; activation < DIST_ACTIVATION_NONE; activation++) { /* a BLAS that goes wrong */
        int wrong = 0;
        dist_context_desc desc = test_context_desc();
        desc.blas.user = &wrong;
        desc.blas.sgemm_fn = wrong_sgemm;
        desc.blas_width = 24;
        ctx = dist_context_create(&desc);
        shape = plain_net(ctx, &net, activation, 0, 1, 0);
        field = dist_shape_field(shape);
        wrong = 3;
        int finite = 0;
        for (int k = 0; k < 12; k++) {
            CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, (size_t)counts[k / 2], p, f, k % 2 ? slope : NULL), ctx);
            for (int i = 0; i < counts[k / 2]; i++) finite += test_finite((double)f[i]);
        }
        SAY(finite == 0, "BLAS that writes NaN: values that are finite", "0", finite);
        camera = shape_camera(16, 16);
        for (int trace = 0; trace < 2; trace++) {
            dist_render_desc how = defaults(trace);
            float g[14];
            CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_ALL, &a, g), ctx);
            SAY(finite_picture(&a) && all_finite(14, g) && a.stats.hits == 0 && a.stats.not_finite > 100,
                "BLAS that writes NaN: rays", "not finite, counted", a.stats.not_finite);
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
#endif
}

TEST(row_23_denormals)
{
    dist_context *ctx = test_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    dist_net *nets[2] = {NULL, NULL};
    for (int k = 0; k < 2; k++) {
        dist_shape *shape = plain_net(ctx, &nets[k], DIST_ACTIVATION_RELU, 0, 1, 0);
        static float w[20000];
        size_t n = dist_net_weight_count(nets[k]);
        memcpy(w, dist_net_weights(nets[k]), n * sizeof *w);
        for (size_t i = 0; i < n; i += 5) w[i] = k ? 1e-40f : 0.0f;
        CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, nets[k], w), ctx);
        CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, NULL), ctx);
        dist_field field = dist_shape_field(shape);
        dist_images out = images(k ? &b : &a);
        field.lipschitz = 2;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        dist_shape_destroy(shape);
        dist_net_destroy(nets[k]);
    }
    SAY(memcmp(a.distance, b.distance, sizeof a.distance) == 0 && memcmp(a.mask, b.mask, sizeof a.mask) == 0,
        "picture with denormal weights", "that of zeros", a.stats.hits);
    dist_context_destroy(ctx);
}

TEST(row_24_huge_codes)
{
    const float sizes[4] = {0, 1e6f, 1e30f, 3e38f};
    dist_context *ctx = test_context();
    dist_camera camera = shape_camera(32, 32);
    for (int k = 0; k < 4; k++) {
        for (int trace = 0; trace < 2; trace++) {
            dist_net *net = NULL;
            dist_shape *shape = plain_net(ctx, &net, trace ? DIST_ACTIVATION_SINE : DIST_ACTIVATION_RELU, 8, 1, 0);
            dist_render_desc how = defaults(trace);
            float code[8], g[14];
            for (int i = 0; i < 8; i++) code[i] = i % 2 ? sizes[k] : -sizes[k];
            dist_status status = dist_shape_set_code(shape, code);
            if (status == DIST_OK) {
                dist_field field = dist_shape_field(shape);
                CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_ALL, &a, g), ctx);
                SAY(finite_picture(&a) && all_finite(14, g), "planes and gradients", "finite", a.stats.not_finite);
            } else {
                SAY(strlen(dist_context_message(ctx)) > 10, "code: status", "a sentence", status);
                dist_context_clear(ctx);
            }
            dist_shape_destroy(shape);
            dist_net_destroy(net);
        }
    }
    dist_context_destroy(ctx);
}

TEST(row_25_sizes)
{
    static unsigned char mask[16384];
    const int widths[3] = {1, 1, 16384}, heights[3] = {1, 16384, 1};
    test_allocator memory;
    memset(&memory, 0, sizeof memory);
    dist_context_desc desc = test_context_desc();
    desc.workers = 1;
    desc.allocator = test_allocator_hook(&memory);
    dist_context *ctx = dist_context_create(&desc);
    test_shape ball = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    dist_field field = shape_field(&ball, 1, 1);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.mask = mask;
    size_t live = memory.live_bytes;
    for (int k = 0; k < 3; k++) {
        dist_camera camera = shape_camera(widths[k], heights[k]);
        camera.fx = camera.fy = 200;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        SAY(memory.live_bytes == live && memory.peak_bytes < 256u << 20, "bytes beyond the caller's planes", "O(tile)",
            memory.live_bytes);
    }
    int side = getenv("DIST_TORTURE") && test_isa() <= DIST_ISA_SCALAR ? 16384 : 2048; /* takes 10 seconds */
    dist_camera huge = shape_camera(side, side);
    dist_images counts;
    dist_stats stats;
    memset(&counts, 0, sizeof counts);
    counts.stats = &stats;
    huge.fx = huge.fy = 200;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &huge, NULL, &counts, NULL), ctx);
    SAY(stats.rays == (unsigned long long)side * (unsigned)side && stats.hits > 1000 && memory.live_bytes == live,
        "large square: rays counted", "all", stats.rays);
    dist_camera none = shape_camera(64, 64);
    none.width = 0;
    SAY(dist_render(ctx, &field, &none, NULL, &out, NULL) == DIST_BAD_ARGUMENT, "0 x 64: status", "-1",
        dist_context_status(ctx));
    dist_context_clear(ctx);
    memory.fail_at = memory.requests + 1; /* the size is looked at, the memory not had */
    memory.fail_onwards = 1;
    dist_camera large = shape_camera(16384, 16384);
    SAY(dist_tape_create(ctx, &large, NULL) == NULL && dist_context_status(ctx) == DIST_OUT_OF_MEMORY,
        "16384 x 16384 without memory: status", "-2", dist_context_status(ctx));
    memory.fail_at = 0;
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, memory.live_blocks);
}

TEST(row_26_sides_that_4_does_not_divide)
{
    const int sides[4] = {1, 3, 61, 63};
    dist_context *ctx = shape_context();
    for (int k = 0; k < 16; k++) {
        dist_camera camera = shape_camera(sides[k % 4], sides[k / 4]);
        test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
        for (int trace = 0; trace < 2; trace++) {
            dist_render_desc how = defaults(trace);
            int masks = 0, n = camera.width * camera.height;
            CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &a), ctx);
            how.no_cones = 1;
            how.paper_row = DIST_PAPER_AGGRESSIVE;
            CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, &how, &b), ctx);
            for (int i = 0; i < n; i++) masks += a.mask[i] != b.mask[i];
            SAY(masks * (trace ? 25 : 400) <= n + 50 * trace, "pixels other than without pyramid",
                trace ? "4 % (the paper's)" : "touches only", masks);
        }
    }
    dist_context_destroy(ctx);
}

TEST(row_27_general_intrinsics)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(48, 48);
    camera.fx = 71;
    camera.fy = 43;
    camera.skew = 9;
    camera.cx = -20;
    camera.cy = 60;
    double worst = 0;
    for (int i = 0; i < 48 * 48; i++) {
        float o[3], d[3];
        double p[3], v[3];
        dist_camera_ray(&camera, (float)(i % 48), (float)(i / 48), o, d);
        shape_pixel(&camera, i % 48, i / 48, p, v);
        for (int k = 0; k < 3; k++) worst = fmax(worst, fabs((double)d[k] - v[k]));
    }
    SAY(worst < 1e-7, "directions against double", "1e-7", worst);
    test_shape shape = shape_make(SHAPE_BOX, 0.4, 0.5, 0.3, 0);
    CHECK_STATUS(DIST_OK, draw(ctx, &shape, 1, 1, &camera, NULL, &a), ctx);
    verdict v = judge(&shape, &camera, 1e-4, &a, 1e-4);
    SAY(v.missed == 0 && v.phantom == 0 && v.broken == 0, "missed, false or beyond the bound", "0",
        v.missed + v.phantom + v.broken);
    dist_context_destroy(ctx);
}

/* Status of a picture with this camera, and whether there is a sentence. */
static void refused(dist_context *ctx, const dist_camera *camera, const char *what, int accept)
{
    test_shape ball = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    dist_context_clear(ctx);
    dist_status status = draw(ctx, &ball, 1, 1, camera, NULL, &a);
    SAY(accept ? status == DIST_OK : status != DIST_OK && strlen(dist_context_message(ctx)) > 20, what,
        accept ? "0" : "refused", status);
}

TEST(row_28_singular_intrinsics)
{
    dist_context *ctx = shape_context();
    const float focal[3] = {0, 1e-30f, -0.0f};
    for (int k = 0; k < 3; k++) {
        dist_camera camera = shape_camera(SIDE, SIDE);
        camera.fy = focal[k];
        refused(ctx, &camera, "f = 0: status", 0);
    }
    dist_context_destroy(ctx);
}

TEST(row_29_no_rotation)
{
    dist_context *ctx = shape_context();
    for (int k = 0; k < 4; k++) {
        dist_camera camera = shape_camera(SIDE, SIDE);
        for (int i = 0; i < 9; i++) {
            if (k == 0) camera.rotation[i] *= 1.1f;
            if (k == 1 && i < 3) camera.rotation[i] = -camera.rotation[i];
            if (k == 2) camera.rotation[i] *= 1.0002f;
            if (k == 3) camera.rotation[i] = 0;
        }
        refused(ctx, &camera,
                k == 0   ? "scaled: status"
                : k == 1 ? "mirrored: status"
                : k == 2 ? "drifted: status"
                         : "zero: status",
                k == 2);
    }
    for (int k = 0; k < 2; k++) { /* too far off to be taken; a move by nothing projects it */
        const float none[3] = {0, 0, 0};
        test_shape ball = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
        dist_camera camera = shape_camera(SIDE, SIDE);
        CHECK_STATUS(DIST_OK, draw(ctx, &ball, 1, 1, &camera, NULL, &b), ctx);
        for (int i = 0; i < 9; i++) camera.rotation[i] *= k ? 1.1f : 1.001f;
        refused(ctx, &camera, "drifted by 1e-3: status", 0);
        dist_camera_move(&camera, none, NULL);
        refused(ctx, &camera, "projected: status", 1);
        int masks = 0;
        for (int i = 0; i < PIXELS; i++) masks += a.mask[i] != b.mask[i];
        SAY(masks <= 2, "projected: pixels other than before the drift", "at most 2 that touch", masks);
    }
    dist_context_destroy(ctx);
}

TEST(row_30_quaternions)
{
    const float zero[4] = {0, 0, 0, 0}, twice[4] = {0, 2, 0, 0}, t[3] = {0, 0, 2};
    dist_camera camera = shape_camera(SIDE, SIDE);
    dist_status status = dist_camera_set_colmap(&camera, zero, t);
    SAY(status != DIST_OK, "zero: status", "refused", status);
    status = dist_camera_set_colmap(&camera, twice, t);
    SAY(status == DIST_OK && fabs((double)camera.rotation[0] - 1) < 1e-6 && fabs((double)camera.rotation[4] + 1) < 1e-6,
        "of length 2: rotation", "1", camera.rotation[0]);
}

/* ---- 31 to 39: gradients, losses, steps -------------------------------------------------------------------------- */

static void flat_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    shape_eval(user, worker, n, points, sdf, NULL);
    if (gradient) memset(gradient, 0, 3 * n * sizeof *gradient);
}

TEST(row_31_no_gradient_at_the_hit)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
    float g[14];
    int wrong = 0;
    shape.power = 3;
    dist_field field = shape_field(&shape, 1, 1);
    CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, NULL, PULL_ALL, &a, g), ctx);
    for (int i = 0; i < PIXELS; i++) {
        double length = shape_length((double)a.normal[3 * i], (double)a.normal[3 * i + 1], (double)a.normal[3 * i + 2]);
        wrong += fabs(length) > 1e-6 && fabs(length - 1) > 1e-5;
    }
    SAY(wrong == 0 && finite_picture(&a) && all_finite(14, g), "normals neither 0 nor unit", "0", wrong);
    for (int mode = DIST_GRADIENT_IMPLICIT; mode <= DIST_GRADIENT_NORMAL; mode++) { /* grad f is exactly 0 */
        dist_render_desc how = defaults(DIST_TRACE_GUARDED);
        how.gradient = mode;
        shape.power = 0;
        field.eval_fn = flat_eval;
        CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_HITS, &a, g), ctx);
        double most = 0;
        for (int i = 0; i < 3 * PIXELS; i++) most = fmax(most, fabs((double)a.normal[i]));
        for (int i = 0; i < 14; i++) most = fmax(most, fabs((double)g[i]));
        SAY(most <= 0 && a.stats.hits > 100, "flat: normals and gradients", "exactly 0", most);
        SAY(a.stats.capped == a.stats.hits, "flat: reported as capped", "every hit", a.stats.capped);
    }
    dist_context_destroy(ctx);
}

TEST(row_32_outline_gradients)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    float ball[4] = {0, 0, 0, 0.6f}, g[14];
    dist_field field = dist_field_sphere(ball);
    for (int mode = DIST_GRADIENT_IMPLICIT; mode <= DIST_GRADIENT_NORMAL; mode++) {
        dist_render_desc how = defaults(DIST_TRACE_GUARDED);
        how.gradient = mode;
        how.gradient_cap = 0.5f;
        CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_ALL, &a, g), ctx);
        SAY(a.stats.capped > 0 && a.stats.capped < a.stats.hits && all_finite(14, g), "capped rays", "counted",
            a.stats.capped);
    }
    dist_context_destroy(ctx);
}

TEST(row_33_secant_with_equal_ends)
{
    dist_context *ctx = shape_context();
    int wrong = 0;
    long most = 0;
    for (int j = 0; j < 30; j++) {
        test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
        shape.power = -1;
        float o[3] = {0.01f * (float)j, 0, 1.2f}, d[3] = {0, 0, -1};
        dist_hit hit = shoot(ctx, &shape, 1, o, d, NULL);
        most = shape.queries > most ? shape.queries : most;
        wrong += hit.status != DIST_RAY_HIT || hit.error > 1e-4f ||
                 fabs(1.2 - sqrt(0.36 - (double)o[0] * (double)o[0]) - (double)hit.distance) > (double)hit.error + 1e-6;
    }
    SAY(wrong == 0, "off, f = 0.01 outside and -0.01 inside", "0", wrong);
    SAY(most <= 112, "queries", "at most 112", most);
    /* found by random scenes: a bracket that ends on f = 0 with a flat neighbor had an error of 0 / 0 */
    test_shape stairs = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
    float o[3] = {0, 0, 1.6f}, d[3] = {0, 0, -1};
    stairs.clamp = 1e-9;
    stairs.slope = 1e-9;
    dist_hit hit = shoot(ctx, &stairs, 1, o, d, NULL);
    SAY(test_finite((double)hit.error) && test_finite((double)hit.distance), "error of a flat hit", "finite",
        hit.error);
    /* found by random scenes: f = 0 at both ends of a bracket, 0 / 0 */
    float best = 0;
    dist_field field = shape_field(&stairs, 1, 1);
    int status = inside_bracket_of_zeros(ctx, &field, 0.1f, 0.2f, &best);
    SAY(best >= 0.1f && best <= 0.2f && status == DIST_RAY_HIT, "bracket of zeros: s", "0.1 to 0.2", best);
    dist_context_destroy(ctx);
}

TEST(row_34_tangent_surface)
{
    dist_context *ctx = shape_context();
    float ball[4] = {0, 0, 0, 0.6f};
    dist_field field = dist_field_sphere(ball);
    dist_camera camera = shape_camera(SIDE, SIDE);
    int most = 0;
    double jump = 0;
    for (int step = 0; step < 20; step++) {
        dist_images out = images(step % 2 ? &b : &a);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        int moved = 0;
        for (int i = 0; i < PIXELS && step > 0; i++) {
            moved += a.mask[i] != b.mask[i];
            jump =
                fmax(jump, fabs((double)a.silhouette[i] - (double)b.silhouette[i]) - (a.silhouette[i] > 0.05f ? 1 : 0));
        }
        most = moved > most ? moved : most;
        camera.translation[0] = nextafterf(camera.translation[0], 10.0f);
    }
    SAY(most <= 1, "pixels of the mask, pose moved by an ulp", "at most 1", most);
    SAY(jump < 1e-4, "silhouette near the outline", "continuous", jump);
    dist_context_destroy(ctx);
}

TEST(row_35_kinks)
{
    dist_context *ctx = shape_context();
    const float box[6] = {0, 0, 0, 0.5f, 0.5f, 0.5f};
    dist_field field = dist_field_box(box);
    const float points[9] = {0.5f, 0.5f, 0.5f, 0.5f, 0.5f, 0, -0.5f, 0, 0.5f};
    float f[3], g[9];
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, 3, points, f, g), ctx);
    for (size_t k = 0; k < 3; k++) {
        double length = shape_length((double)g[3 * k], (double)g[3 * k + 1], (double)g[3 * k + 2]);
        SAY(length > 0.5 && length < 1.0001, "length of a corner's subgradient", "at most 1", length);
    }
    for (int axis = 0; axis < 3; axis++) { /* a ReLU net with all biases 0 has every unit's kink at the origin */
        static float w[20000];
        dist_net *net = NULL;
        dist_shape *shape = plain_net(ctx, &net, DIST_ACTIVATION_RELU, 0, 0, 0);
        size_t n = dist_net_weight_count(net);
        test_random r = test_random_seed(8);
        memset(w, 0, sizeof w);
        for (size_t at = 0, l = 0; l < 4; l++) {
            size_t rows = l < 3 ? 24 : 1, columns = l ? 24 : 3;
            test_random_fill(&r, rows * columns, w + at, -0.4f, 0.4f);
            at += rows * columns + rows;
        }
        CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, w), ctx);
        CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, NULL), ctx);
        dist_field kinked = dist_shape_field(shape);
        float p[9] = {0}, most = 0;
        p[3 + axis] = 1e-3f;
        p[6 + axis] = -1e-3f;
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &kinked, 3, p, f, g), ctx);
        for (int i = 3; i < 9; i++) most = fmaxf(most, fabsf(g[i]));
        SAY(all_finite(9, g) && fabs((double)f[0]) <= 0 && most > 0 && fabs((double)g[axis]) <= 2 * (double)most,
            "slope at a kink", "finite", g[axis]);
        SAY(n > 0 && fabs((double)f[1] - 1e-3 * (double)g[3 + axis]) < 1e-8, "beside it: f", "that side's slope", f[1]);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    dist_context_destroy(ctx);
}

TEST(row_36_none_or_all_rays_hit)
{
    dist_context *ctx = shape_context();
    static unsigned char target[PIXELS];
    static float d[PIXELS];
    const float sizes[3] = {0.05f, 0.05f, 0.9f}, aside[3] = {0.7f, 5, 0};
    for (int j = 0; j < 6; j++) {
        int k = j % 3;
        dist_render_desc how = defaults(j / 3);
        float ball[4] = {0, 0, 0, 0}, rotation[3] = {0}, translation[3] = {0}, code[4] = {0};
        dist_field field = dist_field_sphere(ball);
        dist_camera camera = shape_camera(SIDE, SIDE);
        dist_images out = images(&a), d_out;
        dist_gradients grads;
        ball[3] = sizes[k];
        field = dist_field_sphere(ball);
        field.radius = 1;
        camera.translation[0] += aside[k];
        if (k == 2) camera.fx = camera.fy = 400;
        dist_tape *tape = dist_tape_create(ctx, &camera, &how);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, tape), ctx);
        memset(target, k < 2, sizeof target);
        memset(d, 0, sizeof d);
        float loss = dist_loss_silhouette(PIXELS, a.silhouette, target, 1, d);
        memset(&d_out, 0, sizeof d_out);
        memset(&grads, 0, sizeof grads);
        d_out.silhouette = d;
        grads.rotation = rotation;
        grads.translation = translation;
        grads.code = code;
        CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
        double pull = shape_length((double)translation[0], (double)translation[1], (double)translation[2]);
        SAY(test_finite((double)loss) && all_finite(3, rotation) && all_finite(4, code), "loss", "finite", loss);
        SAY(pull > 0 || fabs((double)code[3]) > 0, k == 2 ? "all hit: pull" : "none hits: pull", "not 0",
            pull + fabs((double)code[3]));
        dist_tape_destroy(tape);
    }
    dist_context_destroy(ctx);
}

TEST(row_37_no_valid_pixel)
{
    const float bad[5] = {0, bits_of(0x7fc00000u), bits_of(0x7f800000u), 1e11f, -1};
    for (int k = 0; k < 5; k++) {
        float depth[4] = {1, 2, 3, 4}, target[4], d[4] = {0}, normal[12] = {0}, d_normal[12] = {0};
        unsigned char none[4] = {0}, all[4] = {1, 1, 1, 1};
        for (int i = 0; i < 4; i++) target[i] = bad[k];
        float loss = dist_loss_depth(4, depth, target, all, 1, d) + dist_loss_depth(4, depth, depth, none, 1, d) +
                     dist_loss_normal(4, normal, normal, all, 1, d_normal) +
                     dist_loss_color(4, normal, normal, none, 1, d_normal);
        SAY(fabs((double)loss) <= 0 && shape_length((double)d[0], (double)d[1], (double)d[2]) <= 0 &&
                all_finite(12, d_normal),
            "loss and gradient", "0", loss);
    }
}

TEST(row_38_warp_out_of_view)
{
    enum { W = 16 };
    static float color[3 * W * W], depth[W * W], d_depth[W * W], d_cameras[12];
    static unsigned char visible[W * W];
    for (int k = 0; k < 3; k++) {
        dist_photo to, from;
        dist_photometric_desc desc;
        float eye[3] = {0, 0, 2.4f}, away[3] = {0, 0, 9}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
        memset(&to, 0, sizeof to);
        memset(&desc, 0, sizeof desc);
        memset(d_depth, 0, sizeof d_depth);
        memset(d_cameras, 0, sizeof d_cameras);
        for (int i = 0; i < W * W; i++) depth[i] = k == 2 ? bits_of(0x7f800000u) : 2;
        for (int i = 0; i < 3 * W * W; i++) color[i] = 0.5f + 0.01f * (float)(i % 7);
        to.color = color;
        to.depth = depth;
        to.camera = dist_camera_look_at(W, W, 0.8f, eye, at, up);
        from = to;
        from.depth = NULL;
        if (k == 0) from.camera = dist_camera_look_at(W, W, 0.8f, eye, away, up); /* looks away: all lies behind it */
        if (k == 1) from.camera.cx += 1000;
        desc.visible = visible;
        float loss = dist_loss_photometric(&to, &from, &desc, 1, d_depth, d_cameras);
        int seen = 0;
        double pull = 0;
        for (int i = 0; i < W * W; i++) {
            seen += visible[i];
            pull += fabs((double)d_depth[i]);
        }
        for (int i = 0; i < 12; i++) pull += fabs((double)d_cameras[i]);
        SAY(seen == 0 && fabs((double)loss) <= 0 && pull <= 0,
            k == 0   ? "behind the other camera: pixels"
            : k == 1 ? "outside its picture: pixels"
                     : "depth infinite: pixels",
            "0", seen);
    }
}

TEST(row_39_adam)
{
    const float gradients[5] = {0, 1e-30f, 1e30f, -3e38f, 1};
    for (int k = 0; k < 6; k++) {
        float x[1] = {0.5f}, g[1], moments[2] = {0, 0};
        dist_adam adam;
        memset(&adam, 0, sizeof adam);
        adam.moments = moments;
        if (k == 5) adam.rate = -1;
        g[0] = gradients[k % 5];
        for (int i = 0; i < 200; i++) dist_adam_step(&adam, 1, x, g);
        SAY(test_finite((double)x[0]) && all_finite(2, moments), "x after 200 steps", "finite", x[0]);
        if (k == 0 || k == 5) SAY(fabs((double)x[0] - 0.5) <= 0, "x for g = 0, or rate below 0", "0.5", x[0]);
    }
}

/* ---- 40 to 46: the machine --------------------------------------------------------------------------------------- */

/* The same rays, 1, 1000 and 65536 at a time. */
static void free_rays_in_groups(dist_context *ctx, const dist_field *field)
{
    enum { RAYS = 65536 };
    static float o[3 * RAYS], d[3 * RAYS];
    static dist_hit all[RAYS], some[RAYS];
    const size_t groups[2] = {1000, 1};
    size_t n = test_quick() ? 4096 : (size_t)RAYS;
    test_random r = test_random_seed(6);
    for (size_t i = 0; i < n; i++) {
        test_random_direction(&r, o + 3 * i);
        for (size_t k = 0; k < 3; k++) d[3 * i + k] = test_random_float(&r, -0.5f, 0.5f) - o[3 * i + k];
    }
    CHECK_STATUS(DIST_OK, dist_trace(ctx, field, n, o, d, NULL, all, NULL), ctx);
    for (int k = 0; k < 2; k++) {
        size_t end = k ? 2000 : n;
        for (size_t i = 0; i < end; i += groups[k])
            CHECK_STATUS(DIST_OK,
                         dist_trace(ctx, field, groups[k] < end - i ? groups[k] : end - i, o + 3 * i, d + 3 * i, NULL,
                                    some + i, NULL),
                         ctx);
        SAY(memcmp(all, some, end * sizeof *all) == 0, "free rays in groups of", "same bits", (double)groups[k]);
    }
}

TEST(row_40_threads)
{
    const int workers[5] = {1, 2, 3, 7, 64};
    static picture first;
    float g[14], g_first[14];
    for (int trace = 0; trace < 2; trace++) {
        for (int k = 0; k < 5; k++) {
            test_scheduler scheduler;
            dist_context_desc desc = test_context_desc();
            dist_render_desc how = defaults(trace);
            scheduler.workers = desc.workers = workers[k];
            scheduler.calls = k;
            if (k) desc.scheduler = test_scheduler_hook(&scheduler);
            dist_context *ctx = dist_context_create(&desc);
            dist_net *net = NULL;
            dist_shape *shape = plain_net(ctx, &net, DIST_ACTIVATION_RELU, 8, 1, 0);
            dist_field field = dist_shape_field(shape);
            dist_camera camera = shape_camera(SIDE, 50);
            CHECK_STATUS(DIST_OK, pull_on(ctx, &field, &camera, &how, PULL_ALL, k ? &b : &first, k ? g : g_first), ctx);
            if (k)
                SAY(memcmp(&first, &b, sizeof b) == 0 && memcmp(g, g_first, sizeof g) == 0,
                    "workers: picture and gradients", "same bits", workers[k]);
            if (k == 0 && trace == 0) free_rays_in_groups(ctx, &field);
            dist_shape_destroy(shape);
            dist_net_destroy(net);
            dist_context_destroy(ctx);
        }
    }
}

TEST(row_41_instruction_sets)
{
    enum { POINTS = 300 };
    static float p[3 * POINTS], expected[POINTS], got[POINTS], slope[3 * POINTS], slope_expected[3 * POINTS];
    test_random r = test_random_seed(4);
    test_random_fill(&r, 3 * POINTS, p, -1, 1);
    const int kinds[3] = {DIST_ACTIVATION_RELU, DIST_ACTIVATION_SOFTPLUS, DIST_ACTIVATION_TANH};
    for (int k = 0; k < 3 * DIST_ISA_NEON; k++) {
        int kind = kinds[k / DIST_ISA_NEON], isa = DIST_ISA_SCALAR + k % DIST_ISA_NEON;
        if (!test_cpu_has(isa)) continue;
        dist_context_desc desc = test_context_desc();
        desc.isa = isa;
        dist_context *ctx = dist_context_create(&desc);
        dist_net *net = NULL;
        dist_shape *shape = plain_net(ctx, &net, kind, 8, 1, 0);
        dist_field field = dist_shape_field(shape);
        double worst = 0, steepest = 0;
        CHECK_STATUS(DIST_OK,
                     dist_field_eval(ctx, &field, POINTS, p, isa == DIST_ISA_SCALAR ? expected : got,
                                     isa == DIST_ISA_SCALAR ? slope_expected : slope),
                     ctx);
        for (int i = 0; i < POINTS && isa != DIST_ISA_SCALAR; i++)
            worst = fmax(worst, fabs((double)expected[i] - (double)got[i]));
        for (int i = 0; i < 3 * POINTS && isa != DIST_ISA_SCALAR; i++)
            steepest = fmax(steepest, fabs((double)slope_expected[i] - (double)slope[i]));
        SAY(worst < 4 * 27 * 6e-8 * 3, dist_isa_name(isa), "sum of 4 layers' rounding", worst);
        if (kind != DIST_ACTIVATION_RELU) /* a unit at its kink may go either way */
            SAY(steepest < 100 * 4 * 27 * 6e-8 * 3, "gradient: off by", "the same, times softplus's 100", steepest);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
}

TEST(row_42_floating_point_state)
{
    const int modes[4] = {FE_TONEAREST, FE_UPWARD, FE_DOWNWARD, FE_TOWARDZERO};
    dist_context *ctx = test_context();
    dist_net *net = NULL;
    dist_shape *shape = plain_net(ctx, &net, DIST_ACTIVATION_RELU, 8, 1, 0);
    dist_field field = dist_shape_field(shape);
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int k = 0; k < 4; k++) {
        dist_images out = images(k ? &b : &a);
        fesetround(modes[k]);
        dist_status status = dist_render(ctx, &field, &camera, NULL, &out, NULL);
        int kept = fegetround() == modes[k];
        fesetround(FE_TONEAREST);
        int differ = 0;
        for (int i = 0; i < PIXELS && k; i++)
            differ +=
                a.mask[i] != b.mask[i] || (a.mask[i] && fabs((double)a.distance[i] - (double)b.distance[i]) > 1e-5);
        SAY(status == DIST_OK && kept && differ <= 2, "rounding mode: pixels that differ", "touches only, mode kept",
            differ);
    }
#if defined(__SSE__)
    const unsigned states[3] = {0x9fc0u, 0x1900u, 0x7f80u}; /* flush to zero; traps; toward zero, for both tracers */
    for (int k = 0; k < 6; k++) {
        dist_render_desc how = defaults(k % 2);
        dist_images out = images(&a);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        out = images(&b);
        unsigned before = _mm_getcsr();
        _mm_setcsr(states[k / 2]);
        dist_status status = dist_render(ctx, &field, &camera, &how, &out, NULL);
        unsigned after = _mm_getcsr() & ~0x3fu;
        _mm_setcsr(before);
        int differ = 0;
        for (int i = 0; i < PIXELS; i++) differ += a.mask[i] != b.mask[i];
        SAY(status == DIST_OK && after == states[k / 2] && differ <= 2, "flush to zero, traps: pixels that differ",
            "touches only, state kept", differ);
    }
#endif
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(row_43_wrong_blas)
{
    for (int k = 0; k < 4; k++) {
        int wrong = k;
        dist_context_desc desc = test_context_desc();
        desc.blas.user = &wrong;
        desc.blas.sgemm_fn = wrong_sgemm;
        dist_context *ctx = dist_context_create(&desc);
        if (k == 1 && dist_context_status(ctx) == DIST_OK) { /* a transposed A may be read with its own stride only */
            SAY(0, "transposes wrongly: status", "refused", 0);
        } else {
            SAY((dist_context_status(ctx) == DIST_OK) == (k == 0),
                k ? "wrong product: status" : "right product: status", k ? "refused" : "0", dist_context_status(ctx));
        }
        dist_context_destroy(ctx);
    }
}

static int life_wrote; /* in spite of a status */

/* A context, net, shape, tape, picture and gradient. */
static dist_status life(test_allocator *memory)
{
    dist_context_desc desc = test_context_desc();
    desc.workers = 1;
    desc.allocator = test_allocator_hook(memory);
    dist_context *ctx = dist_context_create(&desc);
    dist_net *net = NULL;
    dist_shape *shape = plain_net(ctx, &net, DIST_ACTIVATION_RELU, 8, 1, 0);
    dist_field field = dist_shape_field(shape);
    dist_camera camera = shape_camera(16, 16);
    float g[14];
    dist_status status = pull_on(ctx, &field, &camera, NULL, PULL_ALL, &a, g);
    life_wrote = 0;
    for (int i = 0; i < 14 && status != DIST_OK; i++) life_wrote |= fabsf(g[i]) > 0;
    for (int i = 0; i < PIXELS && status != DIST_OK; i++) life_wrote |= a.mask[i] || fabsf(a.depth[i]) > 0;
    if (ctx && dist_context_status(ctx) != DIST_OK) status = dist_context_status(ctx);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return status;
}

TEST(row_44_memory_runs_out)
{
    test_allocator memory;
    memset(&memory, 0, sizeof memory);
    CHECK_STATUS(DIST_OK, life(&memory), NULL);
    size_t requests = memory.requests;
    int wrong = 0;
    for (size_t at = 1; at <= requests; at++) {
        for (int onwards = 0; onwards < 2; onwards++) {
            memset(&memory, 0, sizeof memory);
            memory.fail_at = at;
            memory.fail_onwards = onwards;
            wrong += life(&memory) == DIST_OK || memory.live_blocks != 0 || memory.errors != 0 || life_wrote;
        }
    }
    SAY(wrong == 0 && requests > 4, "requests whose failure is no status, leaks or writes", "0", wrong);
}

/* A field that asks another context's field: allowed; the same context's is documented as forbidden. */
typedef struct nested {
    dist_context *ctx;
    dist_field inner;
    const dist_camera *camera;
    picture *seen;
    int calls;
} nested;

static void nested_render(nested *x)
{
    dist_images out = images(x->seen);
    x->calls++;
    CHECK_STATUS(DIST_OK, dist_render(x->ctx, &x->inner, x->camera, NULL, &out, NULL), x->ctx);
}

static void *nested_alloc(void *user, size_t bytes, size_t alignment)
{
    nested_render((nested *)user);
    char *memory = (char *)malloc(bytes + 2 * alignment); /* alignment is at least a pointer's here */
    if (!memory) return NULL;
    char *p = memory + alignment - (uintptr_t)memory % alignment;
    if ((size_t)(p - memory) < sizeof memory) p += alignment;
    memcpy(p - sizeof memory, &memory, sizeof memory);
    return p;
}

static void nested_free(void *user, void *pointer, size_t bytes)
{
    char *memory;
    (void)bytes;
    nested_render((nested *)user);
    memcpy(&memory, (char *)pointer - sizeof memory, sizeof memory);
    free(memory);
}

static void nested_run(void *user, int count, dist_task_fn task_fn, void *arg)
{
    nested_render((nested *)user);
    for (int i = 0; i < count; i++) task_fn(arg, i, i & 1);
}

static void nested_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    nested *x = (nested *)user;
    (void)worker;
    dist_field_eval(x->ctx, &x->inner, n, points, sdf, gradient);
}

TEST(row_45_callbacks_that_call_back)
{
    dist_context *ctx = shape_context();
    const float ball[4] = {0, 0, 0, 0.6f};
    nested x;
    dist_field outer;
    dist_camera camera = shape_camera(SIDE, SIDE);
    memset(&x, 0, sizeof x);
    x.ctx = shape_context();
    x.inner = dist_field_sphere(ball);
    outer = x.inner;
    outer.user = &x;
    outer.eval_fn = nested_eval;
    outer.adjoint_fn = NULL;
    outer.fused_fn = NULL;
    for (int trace = 0; trace < 2; trace++) {
        dist_render_desc how = defaults(trace);
        dist_images out = images(&a);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &x.inner, &camera, &how, &out, NULL), ctx);
        out = images(&b);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &outer, &camera, &how, &out, NULL), ctx);
        SAY(memcmp(a.distance, b.distance, sizeof a.distance) == 0, "through another context: picture", "same bits",
            b.stats.hits);
    }
    dist_context_desc desc = test_context_desc();
    static picture inner;
    x.seen = &inner;
    x.camera = &camera;
    desc.workers = 2;
    desc.allocator.user = desc.scheduler.user = &x;
    desc.allocator.alloc_fn = nested_alloc;
    desc.allocator.free_fn = nested_free;
    desc.scheduler.run_fn = nested_run;
    dist_context *outside = dist_context_create(&desc);
    dist_images out = images(&b);
    CHECK_STATUS(DIST_OK, dist_render(outside, &x.inner, &camera, NULL, &out, NULL), outside);
    dist_context_destroy(outside);
    out = images(&a);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &x.inner, &camera, NULL, &out, NULL), ctx);
    SAY(memcmp(a.distance, b.distance, sizeof a.distance) == 0 &&
            memcmp(a.distance, inner.distance, sizeof a.distance) == 0 && x.calls > 2,
        "allocator and scheduler that render with another context", "same bits", x.calls);
    dist_context_destroy(x.ctx);
    dist_context_destroy(ctx);
}

TEST(row_46_broken_model_files)
{
    model_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.name = "file";
    desc.code_size = 2;
    desc.code_count = 1;
    model m = model_make(&desc, 9);
    size_t size = 0;
    unsigned char *bytes = model_file(&m, &size);
    test_allocator memory;
    memset(&memory, 0, sizeof memory);
    dist_context_desc context = test_context_desc();
    context.allocator = test_allocator_hook(&memory);
    dist_context *ctx = dist_context_create(&context);
    size_t before = memory.live_bytes;
    int opened = 0, silent = 0;
    memory.peak_bytes = before;
    for (size_t cut = 0; cut < size; cut += test_quick() ? 37 : 7) {
        dist_context_clear(ctx);
        dist_net *net = dist_net_load(ctx, bytes, cut);
        opened += net != NULL;
        silent += strlen(dist_context_message(ctx)) < 10;
        dist_net_destroy(net);
    }
    SAY(opened == 0 && silent == 0, "truncated files opened or without a sentence", "0", opened + silent);
    for (int k = 0; k < 3; k++) { /* over-long; wrong-endian length of the header; a header longer than all */
        unsigned char *wrong = (unsigned char *)malloc(size + 8);
        if (!wrong) break;
        memcpy(wrong, bytes, size);
        memset(wrong + size, 0, 8);
        for (int i = 0; i < 8 && k == 1; i++) wrong[i] = bytes[7 - i];
        if (k == 2) memset(wrong, 0x7f, 8);
        dist_context_clear(ctx);
        dist_net *net = dist_net_load(ctx, wrong, k ? size : size + 8);
        SAY(net == NULL && strlen(dist_context_message(ctx)) > 10,
            k == 0   ? "over-long: status"
            : k == 1 ? "wrong-endian: status"
                     : "huge header: status",
            "refused", dist_context_status(ctx));
        dist_net_destroy(net);
        free(wrong);
    }
    SAY(memory.peak_bytes - before <= 2 * size + (1u << 16), "bytes taken at most", "twice the file and a cap",
        memory.peak_bytes - before);
    for (int k = 0; k < 400; k++) {
        test_random r = test_random_seed((uint64_t)k);
        unsigned char *copy = (unsigned char *)malloc(size);
        if (!copy) break;
        memcpy(copy, bytes, size);
        copy[test_random_int(&r, 0, 400)] ^= (unsigned char)test_random_int(&r, 1, 255);
        dist_context_clear(ctx);
        dist_net *net = dist_net_load(ctx, copy, size);
        silent += !net && strlen(dist_context_message(ctx)) < 10;
        dist_net_destroy(net);
        free(copy);
    }
    SAY(silent == 0 && memory.live_bytes == before, "changed headers refused without a sentence, or leaks", "0",
        silent);
    free(bytes);
    model_free(&m);
    dist_context_destroy(ctx);
}

#define ROW(number, name) \
    do {                  \
        row_now = number; \
        RUN(name);        \
    } while (0)

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    if (getenv("DIST_TORTURE")) printf("row,case,expected,got\n");
    ROW(1, row_01_grazing_rays);
    ROW(2, row_02_steep_slopes);
    ROW(3, row_03_small_slopes);
    ROW(4, row_04_plateaus);
    ROW(5, row_05_clamped_field);
    ROW(6, row_06_saturated_tanh);
    ROW(7, row_07_camera_inside_the_sphere);
    ROW(8, row_08_camera_inside_the_solid);
    ROW(9, row_09_camera_on_the_surface_and_tangents);
    ROW(10, row_10_object_behind);
    ROW(11, row_11_far_cameras);
    ROW(12, row_12_world_scale);
    ROW(13, row_13_focal_lengths);
    ROW(14, row_14_tiny_epsilon);
    ROW(15, row_15_large_epsilon);
    ROW(16, row_16_step_scale);
    ROW(17, row_17_plates_and_rods);
    ROW(18, row_18_nearest_of_two_surfaces);
    ROW(19, row_19_bumps);
    ROW(20, row_20_dead_network);
    ROW(21, row_21_sine_networks);
    ROW(22, row_22_nan_and_infinity);
    ROW(22, row_22_nan_inside_a_net);
    ROW(23, row_23_denormals);
    ROW(24, row_24_huge_codes);
    ROW(25, row_25_sizes);
    ROW(26, row_26_sides_that_4_does_not_divide);
    ROW(27, row_27_general_intrinsics);
    ROW(28, row_28_singular_intrinsics);
    ROW(29, row_29_no_rotation);
    ROW(30, row_30_quaternions);
    ROW(31, row_31_no_gradient_at_the_hit);
    ROW(32, row_32_outline_gradients);
    ROW(33, row_33_secant_with_equal_ends);
    ROW(34, row_34_tangent_surface);
    ROW(35, row_35_kinks);
    ROW(36, row_36_none_or_all_rays_hit);
    ROW(37, row_37_no_valid_pixel);
    ROW(38, row_38_warp_out_of_view);
    ROW(39, row_39_adam);
    ROW(40, row_40_threads);
    ROW(41, row_41_instruction_sets);
    ROW(42, row_42_floating_point_state);
    ROW(43, row_43_wrong_blas);
    ROW(44, row_44_memory_runs_out);
    ROW(45, row_45_callbacks_that_call_back);
    ROW(46, row_46_broken_model_files);
    return test_report();
}
