/* SPDX-License-Identifier: MIT-0
   test_cache.c - caches of empty space: what they show to be empty is, rays and spheres find what they find without
   one, for fewer queries, and a cache of something else is refused. */
#include "shapes.h"

#include "model.h"

enum { RAYS = 3000 };

static float origins[3 * RAYS], directions[3 * RAYS], spheres[4 * RAYS];
static dist_hit plain[RAYS], cached[RAYS];
static dist_contact contacts[2][RAYS];

static double distance_to(const test_shape *shape, const float *p)
{
    double q[3] = {(double)p[0], (double)p[1], (double)p[2]};
    return shape_exact(shape, q);
}

TEST(what_a_cache_shows_empty_is)
{
    dist_context *ctx = shape_context();
    test_shape shapes[SHAPES];
    make_shapes(shapes);
    for (int k = 0; k < SHAPES; k++) {
        for (int resolution = 8; resolution <= 128; resolution *= 4) {
            test_random random = test_random_seed(3 + (unsigned)k);
            dist_field field = shape_field(&shapes[k], 1, 1);
            dist_cache *cache = dist_cache_create(ctx, &field, resolution);
            REQUIRE(cache != NULL);
            CHECK_EQUAL(shapes[k].queries, dist_cache_queries(cache));
            double worst = -1, far = 4.0 / resolution + (shapes[k].clamp > 0 ? 1 : 0);
            int found = 0, missed = 0;
            for (int i = 0; i < 20000; i++) {
                float p[3];
                for (int j = 0; j < 3; j++) p[j] = test_random_float(&random, -1, 1);
                if (p[0] * p[0] + p[1] * p[1] + p[2] * p[2] > 1) continue;
                double clear = (double)inside_cache_clear(cache, p), distance = distance_to(&shapes[k], p);
                worst = fmax(worst, clear - fmax(distance, 0));
                found += clear > 0;
                missed += !(clear > 0) && distance > far;
            }
            CHECK(worst < 1e-6);
            CHECK_EQUAL(0, missed); /* two cells from the surface every place is known to be empty */
            CHECK(resolution < 32 || k == 3 || found > 2000);
            shapes[k].queries = 0;
            dist_cache_destroy(cache);
        }
    }
    dist_context_destroy(ctx);
}

TEST(rays_find_what_they_find_without_a_cache_for_fewer_queries)
{
    dist_context *ctx = shape_context();
    test_shape shapes[SHAPES];
    make_shapes(shapes);
    for (int k = 0; k < SHAPES; k++) {
        for (int mode = 0; mode < 4; mode++) {
            test_random random = test_random_seed(11 + (unsigned)k);
            dist_field field = shape_field(&shapes[k], 1, 1);
            dist_render_desc how;
            dist_stats stats[2];
            memset(&how, 0, sizeof how);
            how.certified = mode == 1;
            how.any_hit = mode == 2;
            how.max_distance = mode == 3 ? 0.8f : 0.0f;
            make_rays(&random, &shapes[k], RAYS, origins, directions);
            dist_cache *cache = dist_cache_create(ctx, &field, 64);
            dist_field with = dist_cache_field(cache);
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, &how, plain, &stats[0]), ctx);
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &with, RAYS, origins, directions, &how, cached, &stats[1]), ctx);
            int differ = 0, beyond = 0, hits = 0;
            for (int i = 0; i < RAYS; i++) {
                differ += plain[i].status != cached[i].status;
                if (plain[i].status != DIST_RAY_HIT || cached[i].status != DIST_RAY_HIT) continue;
                hits++;
                if (mode == 2) continue; /* any blocker does */
                float off = plain[i].distance - cached[i].distance, most = plain[i].error + cached[i].error;
                beyond += !((off < 0 ? -off : off) <= most);
            }
            CHECK(hits > RAYS / 20);
            CHECK(differ <= 3); /* that just touch the surface */
            CHECK_EQUAL(0, beyond);
            double share = (double)stats[1].queries / (double)stats[0].queries;
            CHECK(share < (k == 0 ? 0.95 : 0.65)); /* many rays aim at this ball's surface, and graze it */
            if (test_state.verbose)
                printf("    shape %d, mode %d: %.3f of %llu queries, %d of %d differ\n", k, mode, share,
                       stats[0].queries, differ, RAYS);
            dist_cache_destroy(cache);
        }
    }
    dist_context_destroy(ctx);
}

/* The slope over what a cache skipped says nothing of what comes next: a ray that jumped by it went through a shell. */
TEST(rays_do_not_go_through_thin_shells_by_what_a_cache_skipped)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SHELLS, 0.04, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    dist_cache *cache = dist_cache_create(ctx, &field, 32);
    dist_field with = dist_cache_field(cache);
    test_random random = test_random_seed(3);
    int lost = 0, hits = 0;
    for (int round = 0; round < (test_quick() ? 8 : 30); round++) {
        make_rays(&random, &shape, RAYS, origins, directions);
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, NULL, plain, NULL), ctx);
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &with, RAYS, origins, directions, NULL, cached, NULL), ctx);
        for (int i = 0; i < RAYS; i++) {
            hits += plain[i].status == DIST_RAY_HIT;
            lost += plain[i].status == DIST_RAY_HIT && cached[i].status == DIST_RAY_MISS;
        }
    }
    CHECK(hits > 10000);
    CHECK_EQUAL(0, lost);
    if (test_state.verbose) printf("    %d of %d hits are misses with the cache\n", lost, hits);
    dist_cache_destroy(cache);
    dist_context_destroy(ctx);
}

/* A ball whose f rises faster than its figure says: a step on the way out ends outside of it. */
static void hasty_eval(void *user, int worker, size_t n, const float *p, float *sdf, float *gradient)
{
    (void)user, (void)worker;
    for (size_t i = 0; i < n; i++, p += 3) {
        float length = (float)shape_length((double)p[0], (double)p[1], (double)p[2]);
        sdf[i] = 1.3f * (length - 0.5f);
        for (size_t k = 0; gradient && k < 3; k++) gradient[3 * i + k] = length > 0 ? 1.3f * p[k] / length : 0;
    }
}

TEST(a_cache_hides_no_way_out)
{
    dist_context *ctx = shape_context();
    dist_render_desc how;
    dist_field field;
    int lost = 0;
    memset(&how, 0, sizeof how);
    memset(&field, 0, sizeof field);
    how.inside = DIST_INSIDE_EXIT;
    field.eval_fn = hasty_eval;
    field.radius = 1;
    dist_cache *cache = dist_cache_create(ctx, &field, 64);
    dist_field with = dist_cache_field(cache);
    test_random random = test_random_seed(41);
    for (int i = 0; i < RAYS; i++) {
        test_random_direction(&random, origins + 3 * i);
        test_random_direction(&random, directions + 3 * i);
        float share = test_random_float(&random, 0, 0.49f);
        for (int k = 0; k < 3; k++) origins[3 * i + k] *= share;
    }
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, &how, plain, NULL), ctx);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &with, RAYS, origins, directions, &how, cached, NULL), ctx);
    for (int i = 0; i < RAYS; i++) {
        CHECK_EQUAL(DIST_RAY_HIT, plain[i].status);
        lost += cached[i].status != DIST_RAY_HIT;
        if (cached[i].status == DIST_RAY_HIT) CHECK_NEAR((double)plain[i].distance, (double)cached[i].distance, 1e-4);
    }
    CHECK_EQUAL(0, lost);
    if (test_state.verbose) printf("    %d of %d ways out are lost with the cache\n", lost, RAYS);
    dist_cache_destroy(cache);
    dist_context_destroy(ctx);
}

/* Networks, whose Lipschitz figures are sampled; with what is to be found again by a certified ray. */
TEST(rays_of_networks_find_what_they_find_without_a_cache)
{
    dist_context *ctx = test_context();
    model_desc desc = {.name = "relu", .code_size = 2, .width = 16, .clamp = 0.3};
    double code[MODEL_CODE] = {0.25, 0.25};
    float codef[2] = {0.25f, 0.25f};
    model m = model_make(&desc, 7);
    model_fit_ball(&m, code, 0.6);
    dist_net *net = model_load(ctx, &m);
    dist_shape *shape = dist_shape_create(ctx, net, codef);
    dist_field field = dist_shape_field(shape);
    test_shape ball = shape_make(SHAPE_SPHERE, 0.65, 0, 0, 0);
    test_random random = test_random_seed(5);
    dist_stats stats[2];
    make_rays(&random, &ball, RAYS, origins, directions);
    dist_cache *cache = dist_cache_create(ctx, &field, 0);
    dist_field with = dist_cache_field(cache);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, NULL, plain, &stats[0]), ctx);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &with, RAYS, origins, directions, NULL, cached, &stats[1]), ctx);
    int differ = 0;
    for (int i = 0; i < RAYS; i++) differ += plain[i].status != cached[i].status;
    CHECK(differ <= 3);
    CHECK(stats[0].hits > RAYS / 10);
    CHECK((double)stats[1].queries < 0.75 * (double)stats[0].queries);
    dist_cache_destroy(cache);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    model_free(&m);
    dist_context_destroy(ctx);
}

TEST(spheres_that_are_clear_of_the_surface_ask_nothing)
{
    dist_context *ctx = shape_context();
    test_shape shapes[SHAPES];
    make_shapes(shapes);
    for (int k = 0; k < 3; k++) {
        test_random random = test_random_seed(31 + (unsigned)k);
        dist_field field = shape_field(&shapes[k], 1, 1);
        dist_cache *cache = dist_cache_create(ctx, &field, 64);
        dist_field with = dist_cache_field(cache);
        int clear = 0, touching = 0;
        for (int i = 0; i < RAYS; i++) {
            for (int j = 0; j < 3; j++) spheres[4 * i + j] = test_random_float(&random, -1.2f, 1.2f);
            spheres[4 * i + 3] = i % 2 ? 0.004f : test_random_float(&random, 0.0f, 0.2f); /* an eighth of a cell */
        }
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, RAYS, spheres, contacts[0]), ctx);
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &with, RAYS, spheres, contacts[1]), ctx);
        for (int i = 0; i < RAYS; i++) {
            double gap = distance_to(&shapes[k], spheres + 4 * i) - (double)spheres[4 * i + 3];
            CHECK_EQUAL(contacts[0][i].status, contacts[1][i].status);
            if (contacts[0][i].status == DIST_RAY_HIT) {
                touching++;
                CHECK_BYTES(sizeof contacts[0][i], &contacts[0][i], &contacts[1][i]);
            } else {
                CHECK((double)contacts[1][i].depth >= -gap - 1e-5); /* no farther apart than they are */
            }
            if (gap < 0.07 || i % 2 == 0) continue; /* the diagonal of a cell, and more */
            long before = shapes[k].queries;
            CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &with, 1, spheres + 4 * i, contacts[1]), ctx);
            CHECK_EQUAL(before, shapes[k].queries);
            clear++;
        }
        CHECK(clear > RAYS / 10 && touching > RAYS / 20);
        dist_cache_destroy(cache);
    }
    dist_context_destroy(ctx);
}

TEST(pictures_are_the_same_with_and_without_a_cache)
{
    enum { SIDE = 64 };
    static float depth[2][SIDE * SIDE], silhouette[2][SIDE * SIDE];
    dist_context *ctx = shape_context();
    test_shape torus = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    dist_field field = shape_field(&torus, 1, 1);
    dist_camera camera = shape_camera(SIDE, SIDE);
    dist_cache *cache = dist_cache_create(ctx, &field, 32);
    for (int i = 0; i < 2; i++) {
        dist_field seen = i ? dist_cache_field(cache) : field;
        dist_images out;
        memset(&out, 0, sizeof out);
        out.depth = depth[i];
        out.silhouette = silhouette[i];
        CHECK_STATUS(DIST_OK, dist_render(ctx, &seen, &camera, NULL, &out, NULL), ctx);
    }
    CHECK_BYTES(sizeof depth[0], depth[0], depth[1]);
    CHECK_BYTES(sizeof silhouette[0], silhouette[0], silhouette[1]);
    dist_cache_destroy(cache);
    dist_context_destroy(ctx);
}

static dist_status trace_one(dist_context *ctx, const dist_field *field, float lipschitz)
{
    const float o[3] = {0, 0, 3}, d[3] = {0, 0, -1};
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.lipschitz = lipschitz;
    dist_context_clear(ctx);
    return dist_trace(ctx, field, 1, o, d, &how, plain, NULL);
}

static void other_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)user;
    (void)worker;
    (void)points;
    for (size_t i = 0; i < n; i++) sdf[i] = 1;
    if (gradient) memset(gradient, 0, 3 * n * sizeof *gradient);
}

TEST(a_cache_of_what_has_changed_is_refused_until_it_is_made_anew)
{
    dist_context *ctx = test_context();
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 3;
    desc.width = 16;
    desc.code_size = 2;
    desc.geometric = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    dist_instance one[2];
    memset(one, 0, sizeof one);
    one[0].field = one[1].field = &field;
    one[1].placement.translation[0] = 3;
    dist_scene *scene = dist_scene_create(ctx, 2, one);
    dist_field scenery = dist_scene_field(scene);
    dist_cache *cache = dist_cache_create(ctx, &field, 16), *all = dist_cache_create(ctx, &scenery, 16);
    REQUIRE(cache && all);
    const float code[2] = {0.1f, -0.1f};
    const char *const changed = "field.cache was made of another field, or that has changed since";
    static float weights[4096];
    REQUIRE(dist_net_weight_count(net) <= 4096);
    for (int turn = 0; turn < 4; turn++) {
        dist_field with = dist_cache_field(cache), with_all = dist_cache_field(all);
        CHECK_STATUS(DIST_OK, trace_one(ctx, &with, 0), ctx);
        CHECK_STATUS(DIST_OK, trace_one(ctx, &with_all, 0), ctx);
        if (turn == 0) CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, code), ctx);
        if (turn == 1) {
            for (size_t i = 0; i < dist_net_weight_count(net); i++) weights[i] = 1.01f * dist_net_weights(net)[i];
            CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, weights), ctx);
            CHECK_STATUS(DIST_BAD_ARGUMENT, trace_one(ctx, &with, 0), ctx);
            CHECK_TEXT("have changed since dist_shape_set_code", dist_context_message(ctx));
            dist_context_clear(ctx);
            CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, code), ctx);
        }
        if (turn == 2) {
            one[1].placement.translation[0] = 2.9f;
            CHECK_STATUS(DIST_OK, dist_scene_set(scene, 1, &one[1]), ctx);
        }
        if (turn == 3) { /* to another field, another code, and back: it is what it was */
            dist_shape *fresh = dist_shape_create(ctx, net, NULL);
            dist_field other = dist_shape_field(fresh);
            one[1].field = &other;
            CHECK_STATUS(DIST_OK, dist_scene_set(scene, 1, &one[1]), ctx);
            CHECK_STATUS(DIST_BAD_ARGUMENT, trace_one(ctx, &with_all, 0), ctx);
            one[1].field = &field;
            dist_context_clear(ctx);
            CHECK_STATUS(DIST_OK, dist_scene_set(scene, 1, &one[1]), ctx);
            CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, NULL), ctx);
            CHECK_STATUS(DIST_BAD_ARGUMENT, trace_one(ctx, &with, 0), ctx);
            CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, code), ctx);
            dist_context_clear(ctx);
            dist_shape_destroy(fresh);
        }
        CHECK_STATUS(turn < 2 ? DIST_BAD_ARGUMENT : DIST_OK, trace_one(ctx, &with, 0), ctx);
        if (turn < 2) CHECK_TEXT(changed, dist_context_message(ctx));
        CHECK_STATUS(turn < 3 ? DIST_BAD_ARGUMENT : DIST_OK, trace_one(ctx, &with_all, 0), ctx);
        if (turn < 3) CHECK_TEXT(changed, dist_context_message(ctx));
        dist_context_clear(ctx);
        field = dist_shape_field(shape);
        scenery = dist_scene_field(scene);
        CHECK_STATUS(DIST_OK, dist_cache_update(cache, &with), ctx); /* what is refused can be made anew all the same */
        CHECK_STATUS(DIST_OK, dist_cache_update(all, &scenery), ctx);
    }
    dist_field with = dist_cache_field(cache), moved = with;
    CHECK_STATUS(DIST_OK, trace_one(ctx, &with, 0.9f * field.lipschitz), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, trace_one(ctx, &with, 2.0f * field.lipschitz), ctx);
    CHECK_TEXT("dist_trace: how.lipschitz is", dist_context_message(ctx));
    with.lipschitz *= 2;
    CHECK_STATUS(DIST_BAD_ARGUMENT, trace_one(ctx, &with, 0), ctx);
    CHECK_TEXT("dist_trace: field.lipschitz is", dist_context_message(ctx));
    dist_field steeper = dist_cache_field(cache);
    steeper.lipschitz_far = 2.0f * (steeper.lipschitz_far > 0.0f ? steeper.lipschitz_far : steeper.lipschitz);
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, trace_one(ctx, &steeper, 0), ctx);
    CHECK_TEXT("dist_trace: field.lipschitz_far is", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_OK, dist_cache_update(cache, &with), ctx);
    with = dist_cache_field(cache);
    CHECK_STATUS(DIST_OK, trace_one(ctx, &with, 1.0f), ctx);
    moved.center[0] += 0.5f;
    CHECK_STATUS(DIST_BAD_ARGUMENT, trace_one(ctx, &moved, 0), ctx);
    CHECK_TEXT(changed, dist_context_message(ctx));
    dist_context *other = test_context();
    const float ball[4] = {0, 0, 0, 0.5f};
    dist_field sphere = dist_field_sphere(ball);
    CHECK_STATUS(DIST_OK, dist_cache_update(cache, &sphere), ctx);
    with = dist_cache_field(cache);
    CHECK_STATUS(DIST_BAD_ARGUMENT, trace_one(other, &with, 0), other);
    CHECK_TEXT("field.cache belongs to another context", dist_context_message(other));
    dist_context_destroy(other);
    dist_cache_destroy(all);
    dist_cache_destroy(cache);
    dist_scene_destroy(scene);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* Nearest points and contacts use the caches of a scene's instances, also of one within another. */
TEST(a_stale_cache_of_an_instance_is_refused)
{
    const float here[4] = {-0.5f, 0, 0, 0.2f}, there[4] = {0.5f, 0, 0, 0.2f}, sphere[4] = {-0.65f, 0.1f, 0, 0.1f};
    dist_context *ctx = test_context();
    dist_field a = dist_field_sphere(here), b = dist_field_sphere(there);
    dist_cache *cache = dist_cache_create(ctx, &a, 16);
    REQUIRE(cache != NULL);
    dist_field with = dist_cache_field(cache);
    dist_instance one, outer;
    memset(&one, 0, sizeof one);
    one.field = &with;
    dist_scene *scene = dist_scene_create(ctx, 1, &one);
    dist_field inner = dist_scene_field(scene);
    outer = one;
    outer.field = &inner;
    dist_scene *whole = dist_scene_create(ctx, 1, &outer);
    dist_field fields[2] = {inner, dist_scene_field(whole)};
    for (int turn = 0; turn < 2; turn++) {
        for (int k = 0; k < 2; k++) {
            float closest[3], distance = 0;
            dist_contact contact;
            dist_context_clear(ctx);
            dist_status status = dist_field_collide(ctx, &fields[k], 1, sphere, &contact);
            CHECK_EQUAL(turn ? DIST_BAD_ARGUMENT : DIST_OK, status);
            if (turn) CHECK(strstr(dist_context_message(ctx), "dist_field_collide: an instance: field.cache") != NULL);
            else CHECK_NEAR(0.119722, contact.depth, 1e-4);
            dist_context_clear(ctx);
            status = dist_field_closest_point(ctx, &fields[k], 1, sphere, closest, &distance, NULL);
            CHECK_EQUAL(turn ? DIST_BAD_ARGUMENT : DIST_OK, status);
        }
        dist_context_clear(ctx);
        CHECK_STATUS(DIST_OK, dist_cache_update(cache, &b), ctx);
    }
    dist_scene_destroy(whole);
    dist_scene_destroy(scene);
    dist_cache_destroy(cache);
    dist_context_destroy(ctx);
}

/* Whatever its figures are, also where their quotient is not exact. */
TEST(a_cache_of_what_has_not_changed_is_taken)
{
    dist_context *ctx = test_context();
    test_random random = test_random_seed(9);
    const float ball[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(ball);
    dist_cache *cache = dist_cache_create(ctx, &field, 8);
    for (int i = 0; i < 2000; i++) {
        field.lipschitz = i % 5 ? test_random_float(&random, 1, 2) : 0;
        field.lipschitz_far = i % 3 ? test_random_float(&random, 1, 2) : 0;
        CHECK_STATUS(DIST_OK, dist_cache_update(cache, &field), ctx);
        dist_field with = dist_cache_field(cache);
        CHECK_STATUS(DIST_OK, trace_one(ctx, &with, 0), ctx);
    }
    dist_cache_destroy(cache);
    dist_context_destroy(ctx);
}

/* Certified rays use a cache only where it was made with figures as large as theirs. */
TEST(certified_rays_use_no_cache_of_smaller_figures)
{
    dist_context *ctx = test_context();
    const float ball[4] = {0, 0, 0, 0.5f}, o[3] = {0, 0, 3}, d[3] = {0.05f, 0, -1};
    dist_field field = dist_field_sphere(ball), both;
    field.radius = 2;
    field.certified = 1.5f;
    dist_instance one;
    memset(&one, 0, sizeof one);
    one.field = &field;
    dist_scene *scene = dist_scene_create(ctx, 1, &one);
    both = dist_scene_field(scene);
    CHECK_NEAR(1.5f, both.certified, 0);
    CHECK_NEAR(1.5f, both.certified_far, 0); /* the field's is 0: certified */
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.certified = 1;
    dist_cache *cache = dist_cache_create(ctx, &field, 32);
    dist_stats stats[3];
    for (int k = 0; k < 3; k++) { /* none, too small, large enough */
        dist_field raised = field;
        raised.lipschitz = field.certified;
        if (k == 2) CHECK_STATUS(DIST_OK, dist_cache_update(cache, &raised), ctx);
        dist_field with = dist_cache_field(cache);
        CHECK_STATUS(DIST_OK, dist_trace(ctx, k ? &with : &field, 1, o, d, &how, &plain[k], &stats[k]), ctx);
        CHECK_NEAR(1.5f, stats[k].lipschitz, 0);
    }
    CHECK(stats[0].queries == stats[1].queries && stats[2].queries < stats[1].queries);
    CHECK_BYTES(sizeof plain[0], &plain[0], &plain[1]);
    dist_cache_destroy(cache);
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

static void wrapped_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const dist_field *field = (const dist_field *)user;
    field->eval_fn(field->user, worker, n, points, sdf, gradient);
}

/* A copy of a field with another eval_fn and user, and an instance whose shape is gone before it is replaced. */
TEST(what_is_not_the_librarys_own_is_not_asked_whether_it_has_changed)
{
    dist_context *ctx = test_context();
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 3;
    desc.width = 16;
    desc.geometric = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    dist_shape *shape = dist_shape_create(ctx, net, NULL), *next = dist_shape_create(ctx, net, NULL);
    dist_field inner = dist_shape_field(next), wrapper = inner, field = dist_shape_field(shape);
    wrapper.user = &inner;
    wrapper.eval_fn = wrapped_eval;
    dist_instance one;
    memset(&one, 0, sizeof one);
    one.field = &field;
    dist_scene *scene = dist_scene_create(ctx, 1, &one);
    dist_shape_destroy(shape);
    one.field = &wrapper;
    CHECK_STATUS(DIST_OK, dist_scene_set(scene, 0, &one), ctx);
    CHECK_STATUS(DIST_OK, dist_scene_set(scene, 0, &one), ctx);
    dist_field all = dist_scene_field(scene);
    dist_cache *cache = dist_cache_create(ctx, &all, 16), *own = dist_cache_create(ctx, &wrapper, 16);
    dist_field with = dist_cache_field(cache), alone = dist_cache_field(own);
    CHECK_STATUS(DIST_OK, trace_one(ctx, &with, 0), ctx);
    CHECK_STATUS(DIST_OK, trace_one(ctx, &alone, 0), ctx);
    dist_cache_destroy(own);
    dist_cache_destroy(cache);
    dist_scene_destroy(scene);
    dist_shape_destroy(next);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

static void odd_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)worker;
    (void)points;
    for (size_t i = 0; i < n; i++) sdf[i] = *(const float *)user;
    for (size_t i = 0; gradient && i < 3 * n; i++) gradient[i] = 0;
}

TEST(bad_arguments_and_odd_fields_do_no_harm)
{
    dist_context *ctx = test_context();
    const float numbers[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(numbers), none;
    const int bad[4] = {-8, 7, 9, 520};
    memset(&none, 0, sizeof none);
    for (int i = 0; i < 4; i++) {
        CHECK(dist_cache_create(ctx, &field, bad[i]) == NULL);
        CHECK_TEXT("dist_cache_create: resolution is", dist_context_message(ctx));
        dist_context_clear(ctx);
    }
    CHECK(dist_cache_create(ctx, NULL, 8) == NULL);
    CHECK_TEXT("dist_cache_create: field is NULL", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(dist_cache_create(ctx, &none, 8) == NULL);
    CHECK_TEXT("dist_cache_create: field.eval_fn is NULL", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(dist_cache_create(NULL, &field, 8) == NULL);
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_cache_update(NULL, &field));
    CHECK(dist_cache_field(NULL).eval_fn == NULL);
    CHECK_EQUAL(0, dist_cache_queries(NULL));
    dist_cache_destroy(NULL);
    dist_cache *cache = dist_cache_create(ctx, &field, 8);
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_cache_update(cache, NULL));
    dist_context_clear(ctx);
    const float values[6] = {0, -0.0f, (float)NAN, (float)INFINITY, -1, 1e30f};
    const int ends[6] = {DIST_RAY_INSIDE, DIST_RAY_INSIDE, DIST_RAY_NOT_FINITE, DIST_RAY_NOT_FINITE, DIST_RAY_INSIDE,
                         DIST_RAY_MISS};
    for (int i = 0; i < 6; i++) { /* the same end as without */
        float value = values[i];
        memset(&none, 0, sizeof none);
        none.eval_fn = odd_eval;
        none.user = &value;
        none.radius = 1;
        CHECK_STATUS(DIST_OK, dist_cache_update(cache, &none), ctx);
        dist_field with = dist_cache_field(cache);
        CHECK_STATUS(DIST_OK, trace_one(ctx, &none, 0), ctx);
        int status = plain[0].status;
        CHECK_STATUS(DIST_OK, trace_one(ctx, &with, 0), ctx);
        CHECK_EQUAL(status, plain[0].status);
        if (i >= 2) CHECK_EQUAL(ends[i], status);
    }
    for (int i = 0; i < 2; i++) { /* as small and as large as bounding spheres may be */
        float r = i ? 9e14f : 2e-15f;
        const float ball[4] = {i ? 1e14f : 0, 0, 0, 0.5f * r};
        dist_field far = dist_field_sphere(ball);
        far.radius = r;
        CHECK_STATUS(DIST_OK, dist_cache_update(cache, &far), ctx);
        dist_field with = dist_cache_field(cache);
        const float o[3] = {ball[0], 0, 3 * r}, d[3] = {0, 0, -1};
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &with, 1, o, d, NULL, plain, NULL), ctx);
        CHECK_EQUAL(DIST_RAY_HIT, plain[0].status);
        CHECK_NEAR(2.5 * (double)r, plain[0].distance, 1e-3 * (double)r);
    }
    dist_cache_destroy(cache);
    dist_context_destroy(ctx);
}

TEST(a_cache_takes_memory_once_and_gives_all_of_it_back)
{
    test_allocator allocator;
    dist_context_desc desc = test_context_desc();
    const float numbers[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(numbers);
    memset(&allocator, 0, sizeof allocator);
    desc.allocator = test_allocator_hook(&allocator);
    dist_context *ctx = dist_context_create(&desc);
    size_t before = allocator.requests, live = allocator.live_bytes;
    for (size_t fail = 1; fail <= 2; fail++) {
        allocator.fail_at = before + fail;
        CHECK(dist_cache_create(ctx, &field, 16) == NULL);
        CHECK_EQUAL(DIST_OUT_OF_MEMORY, dist_context_status(ctx));
        CHECK_EQUAL(live, allocator.live_bytes);
        dist_context_clear(ctx);
        before = allocator.requests;
    }
    allocator.fail_at = 0;
    dist_cache *cache = dist_cache_create(ctx, &field, 16);
    CHECK_EQUAL(before + 2, allocator.requests);
    CHECK(allocator.live_bytes - live < 16 * 16 * 16 + 1024);
    CHECK_STATUS(DIST_OK, dist_cache_update(cache, &field), ctx);
    dist_field with = dist_cache_field(cache);
    CHECK_STATUS(DIST_OK, trace_one(ctx, &with, 0), ctx);
    CHECK_EQUAL(before + 2, allocator.requests);
    dist_cache_destroy(cache);
    CHECK_EQUAL(live, allocator.live_bytes);
    dist_context_destroy(ctx);
}

/* Of a field that does not tell whether it has changed, whose user stays the same. */
TEST(another_function_in_a_scene_is_a_change)
{
    dist_context *ctx = test_context();
    const float ball[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(ball), other = field;
    dist_instance one;
    other.eval_fn = other_eval;
    memset(&one, 0, sizeof one);
    one.field = &field;
    dist_scene *scene = dist_scene_create(ctx, 1, &one);
    dist_field scenery = dist_scene_field(scene);
    dist_cache *cache = dist_cache_create(ctx, &scenery, 16);
    REQUIRE(cache != NULL);
    dist_field with = dist_cache_field(cache);
    for (int turn = 0; turn < 4; turn++) { /* there and back */
        one.field = turn & 1 ? &other : &field;
        CHECK_STATUS(DIST_OK, dist_scene_set(scene, 0, &one), ctx);
        CHECK_STATUS(turn & 1 ? DIST_BAD_ARGUMENT : DIST_OK, trace_one(ctx, &with, 0), ctx);
        if (turn & 1) CHECK_TEXT("field.cache was made of another field", dist_context_message(ctx));
        dist_context_clear(ctx);
    }
    dist_cache_destroy(cache);
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

TEST(a_cache_is_the_same_for_any_number_of_workers)
{
    enum { N = 72 };
    static unsigned char first[N * N * N];
    unsigned long long queries = 0;
    const float numbers[5] = {0.1f, 0, 0, 0.5f, 0.2f};
    for (int workers = 1; workers <= 3; workers += 2) {
        dist_context_desc desc = test_context_desc();
        test_scheduler scheduler;
        memset(&scheduler, 0, sizeof scheduler);
        scheduler.workers = desc.workers = workers;
        desc.scheduler = test_scheduler_hook(&scheduler);
        dist_context *ctx = dist_context_create(&desc);
        dist_field field = dist_field_torus(numbers);
        dist_cache *cache = dist_cache_create(ctx, &field, N);
        REQUIRE(cache != NULL);
        if (workers == 1) {
            memcpy(first, inside_cache_cells(cache), sizeof first);
            queries = dist_cache_queries(cache);
            CHECK(queries > 4 * N * N && queries < 12 * N * N);
        } else {
            CHECK_BYTES(sizeof first, first, inside_cache_cells(cache));
            CHECK_EQUAL(queries, dist_cache_queries(cache));
        }
        dist_cache_destroy(cache);
        dist_context_destroy(ctx);
    }
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(what_a_cache_shows_empty_is);
    RUN(rays_find_what_they_find_without_a_cache_for_fewer_queries);
    RUN(rays_do_not_go_through_thin_shells_by_what_a_cache_skipped);
    RUN(a_cache_hides_no_way_out);
    RUN(rays_of_networks_find_what_they_find_without_a_cache);
    RUN(spheres_that_are_clear_of_the_surface_ask_nothing);
    RUN(pictures_are_the_same_with_and_without_a_cache);
    RUN(a_cache_of_what_has_changed_is_refused_until_it_is_made_anew);
    RUN(a_stale_cache_of_an_instance_is_refused);
    RUN(a_cache_of_what_has_not_changed_is_taken);
    RUN(certified_rays_use_no_cache_of_smaller_figures);
    RUN(what_is_not_the_librarys_own_is_not_asked_whether_it_has_changed);
    RUN(bad_arguments_and_odd_fields_do_no_harm);
    RUN(a_cache_takes_memory_once_and_gives_all_of_it_back);
    RUN(another_function_in_a_scene_is_a_change);
    RUN(a_cache_is_the_same_for_any_number_of_workers);
    return test_report();
}
