/* SPDX-License-Identifier: MIT-0
   Warm start: a picture that starts from the last one is the picture that a cold render gives, for less. */
#include "shapes.h"
#include "../examples/common.h"
#include "../bench/bench.h"

enum { SIDE = 256, PIXELS = SIDE * SIDE, LARGE = 512 };

typedef struct picture {
    float distance[LARGE * LARGE], error[LARGE * LARGE], silhouette[LARGE * LARGE];
    unsigned char mask[LARGE * LARGE];
    dist_stats stats;
} picture;

static picture cold, warm;

typedef struct scene {
    dist_context *ctx;
    dist_camera camera;
    dist_field field;
    dist_render_desc how; /* warm */
    dist_tape *tape;
    float numbers[5];
} scene;

static void scene_open(scene *s)
{
    const float torus[5] = {0, 0, 0, 0.55f, 0.2f}; /* the hole in it makes outlines before outlines */
    memset(s, 0, sizeof *s);
    memcpy(s->numbers, torus, sizeof torus);
    s->ctx = shape_context();
    s->camera = shape_camera(SIDE, SIDE);
    s->field = dist_field_torus(s->numbers);
    s->field.center[0] = s->field.center[1] = s->field.center[2] = 0;
    s->field.radius = 1;
    s->how.warm_start = 1;
    s->tape = dist_tape_create(s->ctx, &s->camera, &s->how);
}

static void scene_close(scene *s)
{
    dist_tape_destroy(s->tape);
    dist_context_destroy(s->ctx);
}

static void render(scene *s, int is_warm, int silhouette, picture *p)
{
    dist_images out;
    dist_render_desc how = s->how;
    memset(&out, 0, sizeof out);
    how.warm_start = is_warm;
    out.distance = p->distance;
    out.error = p->error;
    out.mask = p->mask;
    out.silhouette = silhouette ? p->silhouette : NULL;
    out.stats = &p->stats;
    CHECK_STATUS(DIST_OK, dist_render(s->ctx, &s->field, &s->camera, &how, &out, is_warm ? s->tape : NULL), s->ctx);
}

/* Both pictures show the same but for single pixels, one in `share` at most, whose ray touches the surface or a
   crease. */
static void check_same(int silhouette, int share)
{
    int hits = 0, other = 0, far = 0, off = 0, near = 0;
    for (int i = 0; i < PIXELS; i++) {
        hits += cold.mask[i];
        other += cold.mask[i] != warm.mask[i];
        if (cold.mask[i] && warm.mask[i])
            far += fabsf(cold.distance[i] - warm.distance[i]) > cold.error[i] + warm.error[i] + 1e-5f;
        if (!silhouette || cold.mask[i] || warm.mask[i] || cold.silhouette[i] > 0.02f) continue;
        near++;
        off += fabsf(cold.silhouette[i] - warm.silhouette[i]) > 1e-3f;
    }
    CHECK(hits > PIXELS / 20);
    CHECK(other * share <= hits);
    CHECK(far * 500 <= hits);
    CHECK(off * 20 <= near);
}

TEST(a_hundred_small_steps_do_not_drift_and_cost_little)
{
    for (int silhouette = 0; silhouette < 2; silhouette++) {
        scene s;
        unsigned long long queries = 0, hits = 0;
        scene_open(&s);
        for (int i = 0; i <= 100; i++) {
            s.numbers[0] = 0.0005f * (float)i;
            s.numbers[2] = 0.0003f * (float)i;
            render(&s, 1, silhouette, &warm);
            queries += i ? warm.stats.queries : 0;
            hits += i ? warm.stats.hits : 0;
            if (i % 25) continue;
            render(&s, 0, silhouette, &cold);
            check_same(silhouette, 1000);
            if (i) CHECK(warm.stats.queries < cold.stats.queries * 2 / 3);
        }
        if (!silhouette) CHECK((double)queries < 1.2 * (double)hits);
        scene_close(&s);
    }
}

TEST(larger_steps_out_of_pixels_and_into_them_are_seen_at_once)
{
    scene s;
    scene_open(&s);
    for (int i = 0; i < 24; i++) {
        s.numbers[0] = 0.2f * sinf(0.4f * (float)i);
        s.numbers[1] = i > 12 ? 0.25f : 0.0f; /* one jump */
        s.numbers[4] = 0.2f + 0.002f * (float)(i % 5);
        render(&s, 1, 0, &warm);
        render(&s, 0, 0, &cold);
        check_same(0, 500);
    }
    scene_close(&s);
}

/* Two spheres: the second comes out of nothing, before the first, beside it and far away from it. */
static float second[4];

static void pair_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)worker;
    (void)gradient;
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i, *b = second;
        float f = sqrtf(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) - *(const float *)user;
        float x = p[0] - b[0], y = p[1] - b[1], z = p[2] - b[2];
        float g = sqrtf(x * x + y * y + z * z) - b[3];
        sdf[i] = f < g ? f : g;
    }
}

TEST(what_comes_out_of_nothing_is_seen_at_once)
{
    const float places[3][3] = {{0.45f, 0.3f, 0.6f}, {0.0f, 0.6f, 0.0f}, {-0.6f, -0.6f, 0.2f}};
    for (int k = 0; k < 3; k++) {
        scene s;
        float radius = 0.4f;
        scene_open(&s);
        s.field.user = &radius;
        s.field.eval_fn = pair_eval;
        memcpy(second, places[k], sizeof places[k]);
        for (int i = 0; i < 8; i++) {
            second[3] = i < 3 ? -0.3f : 0.06f + 0.002f * (float)i;
            int turns = i < 7 ? 1 : test_quick() ? 64 : 256; /* by then every miss has had its turn */
            for (int j = 0; j < turns; j++) render(&s, 1, 0, &warm);
            render(&s, 0, 0, &cold);
            check_same(0, i == 7 || i < 3 ? 1000 : 250); /* pixels of its outline may come late */
        }
        scene_close(&s);
    }
}

/* A sphere that jumps to where the cones cleared whole blocks; with a silhouette these pixels' least |f| is above 0. */
TEST(what_jumps_to_where_all_was_clear_is_seen_at_once)
{
    const float eye[3] = {0.4f, 0, 3}, at[3] = {0.4f, 0, 0}, hidden[4] = {0, 0.1f, 0, 0.1f},
                there[4] = {0.9f, 0.1f, 0, 0.15f};
    for (int silhouette = 0; silhouette < 2; silhouette++) {
        scene s;
        float radius = 0.3f;
        scene_open(&s);
        s.field.user = &radius;
        s.field.eval_fn = pair_eval;
        s.field.radius = 1.5f;
        s.camera = dist_camera_look_at(SIDE, SIDE, 0.6f, eye, at, NULL);
        for (int i = 0; i < 8; i++) {
            memcpy(second, i < 4 ? hidden : there, sizeof second);
            render(&s, 1, silhouette, &warm);
            render(&s, 0, silhouette, &cold);
            check_same(silhouette, 250);
        }
        scene_close(&s);
    }
}

/* The first picture has no cones, as it asked for none or for a few pixels only, so it does not tell where nothing was:
   the next one is no warm start. A ball comes to stand before another or beside it; 708 pixels still saw that. */
TEST(pictures_without_cones_are_no_beginning)
{
    static unsigned char few[PIXELS];
    const float eye[3] = {0, 0, 3}, hidden[4] = {0, 0.1f, 0, 0.1f},
                there[2][4] = {{0, 0.1f, 0.7f, 0.15f}, {0.75f, 0.1f, 0, 0.15f}};
    for (int i = 0; i < PIXELS; i++) few[i] = i % 2 == 0 && i / SIDE % 2 == 0;
    for (int k = 0; k < 8; k++) {
        scene s;
        float radius = 0.4f;
        int sparse = k & 1, silhouette = k / 2 & 1;
        scene_open(&s);
        s.field.user = &radius;
        s.field.eval_fn = pair_eval;
        s.camera = dist_camera_look_at(SIDE, SIDE, 0.75f, eye, NULL, NULL);
        memcpy(second, hidden, sizeof second);
        s.how.no_cones = !sparse;
        s.how.pixels = sparse ? few : NULL;
        render(&s, 1, silhouette, &warm);
        s.how.no_cones = 0;
        s.how.pixels = NULL;
        memcpy(second, there[k / 4], sizeof second);
        render(&s, 0, silhouette, &cold);
        render(&s, 1, silhouette, &warm);
        int other = 0;
        for (int i = 0; i < PIXELS; i++)
            other += cold.mask[i] != warm.mask[i] ||
                     fabsf(cold.distance[i] - warm.distance[i]) > cold.error[i] + warm.error[i] + 1e-5f;
        CHECK_EQUAL(0, other);
        scene_close(&s);
    }
}

/* A tube that grows by a 20th of a pixel a render, without a silhouette: a ray that missed it may know another of its
   least |f|, or none, and is then told by the hit next to it. Some were late by 38 renders. */
TEST(no_outline_that_grows_is_late_by_more_than_eight_renders)
{
    enum { EDGE = 192 };
    static unsigned char late[EDGE * EDGE];
    const float eye[3] = {1.2f, 1.4f, 2.2f};
    scene s;
    int hits = 0, latest = 0;
    scene_open(&s);
    s.numbers[3] = 0.5f;
    s.numbers[4] = 0.12f;
    s.camera = dist_camera_look_at(EDGE, EDGE, 0.75f, eye, NULL, NULL);
    dist_tape_destroy(s.tape);
    s.tape = dist_tape_create(s.ctx, &s.camera, &s.how);
    for (int k = 0; k < 200; k++) {
        s.numbers[0] += 5e-4f;
        s.numbers[4] += 5e-4f;
        render(&s, 1, 0, &warm);
        render(&s, 0, 0, &cold);
        for (int i = 0; i < EDGE * EDGE; i++) {
            hits += cold.mask[i];
            late[i] = (unsigned char)(cold.mask[i] && !warm.mask[i] ? late[i] + 1 : 0);
            latest = late[i] > latest ? late[i] : latest;
        }
    }
    CHECK(hits > 1000 * 200);
    CHECK(latest <= 8);
    if (test_state.verbose) printf("    at most %d renders late\n", latest);
    scene_close(&s);
}

/* The camera stands .002 before a solid behind its back and beside another one. */
TEST(what_lies_behind_the_camera_is_not_seen)
{
    const float eye[3] = {0, 0, 0.302f}, at[3] = {0, 0, 1}, beside[4] = {0.1f, 0, 0.352f, 0.1f};
    for (int silhouette = 0; silhouette < 2; silhouette++) {
        scene s;
        float radius = 0.3f;
        int behind = 0, other = 0, hits = 0;
        scene_open(&s);
        s.field.user = &radius;
        s.field.eval_fn = pair_eval;
        memcpy(second, beside, sizeof second);
        s.camera = dist_camera_look_at(SIDE, SIDE, 1.2f, eye, at, NULL);
        for (int i = 0; i < 6; i++) {
            radius -= i == 3 ? 1e-4f : 0.0f;
            render(&s, 1, silhouette, &warm);
            render(&s, 0, silhouette, &cold);
            for (int k = 0; k < PIXELS; k++) {
                behind += warm.mask[k] && warm.distance[k] < 0;
                other += warm.mask[k] != cold.mask[k];
                hits += cold.mask[k];
            }
        }
        if (test_state.verbose) printf("    %d behind, %d other than cold, of %d hits\n", behind, other, hits);
        CHECK(hits > PIXELS / 2);
        CHECK_EQUAL(0, behind);
        CHECK(other * 1000 <= hits);
        scene_close(&s);
    }
}

/* A speck that comes out of nothing close above a surface, where f at the cones' stops does not betray it. */
TEST(what_nothing_foretells_is_seen_when_its_turn_comes)
{
    scene s;
    float radius = 0.6f;
    int wrong = 0, last = 0, turns = test_quick() ? 0 : 512;
    scene_open(&s);
    s.field.user = &radius;
    s.field.eval_fn = pair_eval;
    second[0] = 0.62f * sinf(0.15f);
    second[1] = 0.05f;
    second[2] = 0.62f * cosf(0.15f);
    second[3] = -0.3f;
    for (int i = 0; i < 4; i++) render(&s, 1, 0, &warm);
    second[3] = 0.01f;
    render(&s, 0, 0, &cold);
    for (int i = 1; i <= turns; i++) {
        render(&s, 1, 0, &warm);
        wrong = 0;
        for (int j = 0; j < PIXELS; j++)
            wrong += cold.mask[j] != warm.mask[j] ||
                     (cold.mask[j] && fabsf(cold.distance[j] - warm.distance[j]) > cold.error[j] + warm.error[j]);
        if (wrong) last = i;
    }
    if (test_state.verbose) printf("    last seen wrong in render %d\n", last);
    CHECK_EQUAL(0, wrong);
    CHECK(last > 1 || turns == 0); /* else it shows nothing */
    scene_close(&s);
}

TEST(outlines_that_pass_each_other_are_followed)
{
    for (int k = 0; k < 2; k++) { /* a small sphere moves along before and behind the other, past both its outlines */
        scene s;
        float radius = 0.35f;
        unsigned long long queries = 0, all = 0;
        scene_open(&s);
        s.field.user = &radius;
        s.field.eval_fn = pair_eval;
        for (int i = 0; i <= 240; i++) {
            second[0] = -0.6f + 0.005f * (float)i; /* about half a pixel a step */
            second[1] = k ? 0.15f : 0.1f;
            second[2] = k ? -0.55f : 0.55f;
            second[3] = 0.12f;
            render(&s, 1, 0, &warm);
            if (i % 8) continue;
            render(&s, 0, 0, &cold);
            check_same(0, 250);
            queries += warm.stats.queries;
            all += cold.stats.queries;
        }
        CHECK(queries < all * 7 / 10);
        scene_close(&s);
    }
}

TEST(another_camera_or_field_is_a_cold_start)
{
    scene s;
    const float turn[3] = {0, 0.02f, 0};
    float other[5] = {0.1f, 0, 0, 0.5f, 0.2f};
    scene_open(&s);
    for (int k = 0; k < 2; k++) {
        render(&s, 1, 0, &warm);
        render(&s, 1, 0, &warm);
        if (k == 0) dist_camera_move(&s.camera, turn, NULL);
        if (k == 1) s.field.user = other;
        render(&s, 1, 0, &warm);
        render(&s, 0, 0, &cold);
        CHECK_EQUAL(cold.stats.queries, warm.stats.queries);
        CHECK_BYTES(PIXELS * sizeof(float), cold.distance, warm.distance);
    }
    scene_close(&s);
}

/* A field that moves as it is. */
typedef struct moving {
    dist_field still;
    float by[3];
} moving;

static void moving_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const moving *m = (const moving *)user;
    float moved[3 * 64];
    for (size_t first = 0; first < n; first += 64) {
        size_t count = n - first < 64 ? n - first : 64;
        for (size_t i = 0; i < 3 * count; i++) moved[i] = points[3 * first + i] - m->by[i % 3];
        m->still.eval_fn(m->still.user, worker, count, moved, sdf + first, gradient ? gradient + 3 * first : NULL);
    }
}

/* `count` steps of `step` radii of a net's shape at 512 x 512 cost at most `most` queries a hit. In the last picture at
   most .2 % of the hits are holes or false hits and .4 % beyond both error bounds of a cold one, and 5 % of the
   silhouette around it off by more than .002. */
static void check_steps(const char *name, int code, float step, int silhouette, int count, double most)
{
    const float toward[3] = {0.8f, 0.36f, 0.48f};
    unsigned long long queries = 0, hits = 0;
    int both = 0, other = 0, far = 0, outside = 0, off = 0;
    scene s;
    moving m;
    memset(&s, 0, sizeof s);
    memset(&m, 0, sizeof m);
    s.ctx = shape_context();
    dist_net *net = load_net_or_skip(s.ctx, name);
    if (!net) {
        dist_context_destroy(s.ctx);
        SKIP("a net is not there");
    }
    dist_shape *shape = dist_shape_create(s.ctx, net, dist_net_code_size(net) ? dist_net_code(net, code) : NULL);
    m.still = dist_shape_field(shape);
    s.field = m.still;
    s.field.user = &m;
    s.field.eval_fn = moving_eval;
    s.field.color_fn = NULL;
    s.camera = bench_camera(&s.field, LARGE, LARGE);
    s.how.warm_start = 1;
    s.tape = dist_tape_create(s.ctx, &s.camera, &s.how);
    for (int i = 0; i <= count; i++) {
        render(&s, 1, silhouette, &warm);
        queries += i ? warm.stats.queries : 0;
        hits += i ? warm.stats.hits : 0;
        for (int k = 0; k < 3 && i < count; k++) m.by[k] += step * s.field.radius * toward[k];
    }
    render(&s, 0, silhouette, &cold);
    for (int i = 0; i < LARGE * LARGE; i++) {
        other += cold.mask[i] != warm.mask[i];
        if (cold.mask[i] && warm.mask[i]) {
            both++;
            far += fabsf(cold.distance[i] - warm.distance[i]) > cold.error[i] + warm.error[i];
        }
        if (!silhouette || cold.mask[i] || warm.mask[i] || cold.silhouette[i] > 0.1f) continue;
        outside++;
        off += fabsf(cold.silhouette[i] - warm.silhouette[i]) > 2e-3f;
    }
    if (test_state.verbose)
        printf("    %s, %g radii a step%s: %.3f queries a hit; other, beyond the bounds: %d, %d of %d\n", name,
               (double)step, silhouette ? ", silhouette" : "", (double)queries / (double)hits, other, far, both);
    CHECK((double)queries <= most * (double)hits);
    CHECK(other * 500 <= both);
    CHECK(far * 250 <= both);
    CHECK(off * 20 <= outside);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    scene_close(&s);
}

TEST(nets_that_move_by_half_a_thousandth_cost_1_2_queries_a_hit_and_do_not_drift)
{
    if (!test_quick()) check_steps("embedded", 5, 5e-4f, 0, 100, 0.65);
    if (!test_quick()) check_steps("embedded", 5, 5e-4f, 1, 100, 0.9);
    check_steps("embedded", 5, 2e-3f, 0, test_quick() ? 20 : 100, 1.25);
    check_steps("embedded", 5, 2e-3f, 1, test_quick() ? 20 : 100, 1.5);
}

TEST(trained_nets_of_the_test_data_do_not_drift_either)
{
    const struct {
        const char *net;
        int code;
        float step;
        int silhouette;
        double most;
    } rows[] = {
        {"fox", 0, 2e-3f, 0, 1.85},         {"fox", 0, 5e-4f, 1, 1.55},
        {"bob_spot", 1, 5e-4f, 0, 0.7},     {"bob_spot", 1, 4e-4f, 1, 0.95},
        {"bob_spot", 1, 2e-3f, 0, 1.3},     {"bunny_relu", 0, 5e-4f, 0, 0.8},
        {"rings", 0, 5e-4f, 0, 1.1},        {"rings", 0, 2e-3f, 0, 2.1},
        {"primitives", 13, 5e-4f, 0, 0.35}, {"primitives", 13, 2e-3f, 0, 0.55},
        {"chairs", 3, 5e-4f, 0, 0.55},      {"mug_camera_bottle", 0, 5e-4f, 0, 1.25},
        {"mug_camera_bottle", 0, 1e-3f, 0, 2.1}, /* much of a thin part's width */
    };
    check_steps("fox", 0, 5e-4f, 0, test_quick() ? 20 : 100, 0.95);
    for (size_t i = 0; i < sizeof rows / sizeof rows[0] && !test_quick(); i++)
        check_steps(rows[i].net, rows[i].code, rows[i].step, rows[i].silhouette, 40, rows[i].most);
}

/* What neighbors moved by may be an old error of theirs that they mended. */
TEST(moved_hits_of_a_fine_epsilon_keep_their_error_bounds)
{
    int both = 0, far = 0;
    for (int code = 5; code < (test_quick() ? 25 : 255); code += 10) {
        scene s;
        float mine[256], beside[256];
        memset(&s, 0, sizeof s);
        s.ctx = shape_context();
        dist_net *net = load_net_or_skip(s.ctx, "embedded");
        REQUIRE(net != NULL && dist_net_code_size(net) <= 256);
        memcpy(mine, dist_net_code(net, code), (size_t)dist_net_code_size(net) * sizeof(float));
        for (int i = 0; i < dist_net_code_size(net); i++) beside[i] = mine[i] * (i % 2 ? 1.0005f : 0.9995f);
        dist_shape *shape = dist_shape_create(s.ctx, net, mine);
        s.field = dist_shape_field(shape);
        s.camera = bench_camera(&s.field, 64, 64);
        s.how.warm_start = 1;
        s.how.epsilon = 1e-6f;
        s.tape = dist_tape_create(s.ctx, &s.camera, &s.how);
        for (int i = 0; i < 16; i++) {
            dist_shape_set_code(shape, i % 2 ? mine : beside);
            render(&s, 1, i & 4, &warm);
        }
        s.how.epsilon = 1e-7f;
        s.how.certified = 1;
        render(&s, 0, 0, &cold);
        for (int i = 0; i < 64 * 64; i++) {
            if (!cold.mask[i] || !warm.mask[i]) continue;
            both++;
            far += fabsf(cold.distance[i] - warm.distance[i]) > cold.error[i] + warm.error[i];
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        scene_close(&s);
    }
    CHECK(both > 500);
    CHECK(far * 1000 <= both);
}

/* A random net of 4 layers of 32 ReLU whose zero set lies in the sphere, f of a mean slope of 1; NULL: it does not. */
static dist_net *random_net(dist_context *ctx, test_random *random, const float code[8])
{
    enum { LAYERS = 4, WIDTH = 32, SAMPLES = 4000 };
    static float weights[5000], at[3 * SAMPLES], sdf[SAMPLES], gradient[3 * SAMPLES];
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = LAYERS, desc.width = WIDTH, desc.code_size = 8, desc.code_count = 1;
    desc.output_linear = 1, desc.bound = 1, desc.clamp = 1000;
    dist_net *net = dist_net_create(ctx, &desc);
    size_t count = dist_net_weight_count(net), n = 0;
    for (int layer = 0; layer <= LAYERS; layer++) {
        int in = layer > 0 ? WIDTH : 11, out = layer < LAYERS ? WIDTH : 1;
        double scale = (layer < LAYERS ? 2 : 1) / sqrt(layer > 0 ? WIDTH : 3);
        for (int k = 0; k < in * out; k++) weights[n++] = (float)(scale * test_random_normal(random));
        for (int k = 0; k < out; k++) weights[n++] = layer < LAYERS ? (float)(0.5 * test_random_normal(random)) : 0.0f;
    }
    CHECK_EQUAL(count, n);
    double low[2], high[2], slope = 0; /* over the sphere's surface, and in it */
    dist_net_set_weights(ctx, net, weights);
    for (int inside = 0; inside < 2; inside++) {
        dist_shape *shape = dist_shape_create(ctx, net, code);
        dist_field field = dist_shape_field(shape);
        for (int i = 0; i < SAMPLES; i++) {
            float r = inside ? 0.95f * cbrtf(test_random_float(random, 0, 1)) : 0.98f;
            test_random_direction(random, at + 3 * i);
            for (int k = 0; k < 3; k++) at[3 * i + k] *= r;
        }
        dist_field_eval(ctx, &field, SAMPLES, at, sdf, gradient);
        low[inside] = 1e30, high[inside] = -1e30;
        for (int i = 0; i < SAMPLES; i++) {
            low[inside] = fmin(low[inside], (double)sdf[i]);
            high[inside] = fmax(high[inside], (double)sdf[i]);
            const float *g = gradient + 3 * i;
            slope += inside * shape_length((double)g[0], (double)g[1], (double)g[2]) / SAMPLES;
        }
        dist_shape_destroy(shape);
    }
    int flip = high[1] - high[0] > low[0] - low[1];
    double gap = (flip ? high[1] - high[0] : low[0] - low[1]) / slope;
    for (int k = 0; k < WIDTH; k++) weights[n - 1 - WIDTH + (size_t)k] *= (float)((flip ? -1 : 1) / slope);
    weights[n - 1] = (float)((flip ? high[0] : -low[0]) / slope + 0.03 * gap);
    dist_net_set_weights(ctx, net, weights);
    if (gap > 0.12) return net;
    dist_net_destroy(net);
    return NULL;
}

/* A hit that was moved as its neighbors were, and not asked since, may be off by as much as it was then: where the code
   stands still again, too. */
TEST(hits_that_no_one_has_asked_since_they_moved_keep_their_errors)
{
    scene s;
    int nets = 0, beyond = 0, hits = 0;
    test_random random = test_random_seed(83);
    scene_open(&s);
    while (nets < 12) {
        float code[8];
        for (int k = 0; k < 8; k++) code[k] = 0.3f * (float)test_random_normal(&random);
        dist_net *net = random_net(s.ctx, &random, code);
        if (!net) continue;
        dist_shape *shape = dist_shape_create(s.ctx, net, code);
        nets++;
        s.field = dist_shape_field(shape);
        s.how.certified = 0;
        s.how.lipschitz = 0;
        render(&s, 1, 0, &warm);
        for (int k = 0; k < 8; k++) code[k] += 0.0035f * (float)(k % 2 ? 1 : -1);
        dist_shape_set_code(shape, code);
        for (int step = 0; step < 3; step++) render(&s, 1, 0, &warm);
        s.how.certified = 1;
        s.how.lipschitz = 3 * fmaxf(s.field.certified, s.field.certified_far);
        render(&s, 0, 0, &cold);
        for (int i = 0; i < PIXELS; i++) {
            if (!cold.mask[i] || !warm.mask[i]) continue;
            hits++;
            beyond += fabsf(cold.distance[i] - warm.distance[i]) > cold.error[i] + warm.error[i] + 1e-4f;
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    CHECK(hits > 50000);
    CHECK(beyond < hits / 2000);
    if (test_state.verbose) printf("    of %d hits of %d nets %d are off by more than they say\n", hits, nets, beyond);
    scene_close(&s);
}

TEST(a_warm_start_needs_its_tape)
{
    scene s;
    dist_images out;
    dist_render_desc how;
    scene_open(&s);
    memset(&out, 0, sizeof out);
    memset(&how, 0, sizeof how);
    out.mask = warm.mask;
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(s.ctx, &s.field, &s.camera, &s.how, &out, NULL), s.ctx);
    CHECK_TEXT("warm_start", dist_context_message(s.ctx));
    dist_context_clear(s.ctx);
    dist_tape *plain = dist_tape_create(s.ctx, &s.camera, &how);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(s.ctx, &s.field, &s.camera, &s.how, &out, plain), s.ctx);
    dist_context_clear(s.ctx);
    dist_tape_destroy(plain);
    dist_camera small = shape_camera(SIDE / 2, SIDE);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(s.ctx, &s.field, &small, &s.how, &out, s.tape), s.ctx);
    dist_context_clear(s.ctx);
    how = s.how;
    how.trace = DIST_TRACE_PAPER;
    CHECK(dist_tape_create(s.ctx, &s.camera, &how) == NULL);
    dist_context_clear(s.ctx);
    render(&s, 0, 0, &cold);
    /* cold into a warm tape */
    CHECK_STATUS(DIST_OK, dist_render(s.ctx, &s.field, &s.camera, NULL, &out, s.tape), s.ctx);
    render(&s, 1, 0, &warm);
    CHECK(warm.stats.queries < cold.stats.queries);
    scene_close(&s);
}

/* What a ray that is traced anew knew before is no sample of that trace: the distance to a sheet is as steep as 1. */
TEST(a_warm_start_meets_no_slope_that_is_not_there)
{
    enum { WIDE = 40, HIGH = 32 };
    float sheet[6] = {0, 0, 0, 0, 0.5f, 0.5f}, up[3] = {0, 1, 0};
    dist_context *ctx = shape_context();
    dist_field field = dist_field_box(sheet);
    for (int k = 6; k < 16; k++) {
        float r = field.radius, eye[3] = {0.8f * r * (1.0f + 0.02f * (float)k), 0.5f * r, 2.5f * r};
        dist_camera camera = dist_camera_look_at(WIDE, HIGH, 0.7f, eye, NULL, up);
        dist_render_desc how;
        dist_images out;
        dist_stats stats;
        memset(&how, 0, sizeof how);
        memset(&out, 0, sizeof out);
        how.warm_start = 1;
        out.distance = cold.distance;
        out.mask = cold.mask;
        out.stats = &stats;
        dist_tape *tape = dist_tape_create(ctx, &camera, &how);
        for (int i = 0; i < 3; i++) {
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, tape), ctx);
            CHECK(stats.hits > 100);
            CHECK_EQUAL(0, stats.steepest);
        }
        dist_tape_destroy(tape);
    }
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(a_hundred_small_steps_do_not_drift_and_cost_little);
    RUN(larger_steps_out_of_pixels_and_into_them_are_seen_at_once);
    RUN(what_comes_out_of_nothing_is_seen_at_once);
    RUN(what_jumps_to_where_all_was_clear_is_seen_at_once);
    RUN(pictures_without_cones_are_no_beginning);
    RUN(no_outline_that_grows_is_late_by_more_than_eight_renders);
    RUN(what_lies_behind_the_camera_is_not_seen);
    RUN(what_nothing_foretells_is_seen_when_its_turn_comes);
    RUN(outlines_that_pass_each_other_are_followed);
    RUN(another_camera_or_field_is_a_cold_start);
    RUN(nets_that_move_by_half_a_thousandth_cost_1_2_queries_a_hit_and_do_not_drift);
    RUN(trained_nets_of_the_test_data_do_not_drift_either);
    RUN(moved_hits_of_a_fine_epsilon_keep_their_error_bounds);
    RUN(hits_that_no_one_has_asked_since_they_moved_keep_their_errors);
    RUN(a_warm_start_needs_its_tape);
    RUN(a_warm_start_meets_no_slope_that_is_not_there);
    return test_report();
}
