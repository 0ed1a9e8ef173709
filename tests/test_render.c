/* SPDX-License-Identifier: MIT-0
   Pictures: what each plane means, what it costs, and that size, distance, scale, workers and order of tasks change
   nothing. Numbers in comments are rows of the table of hard cases. */
#include "shapes.h"

enum { SIDE = 96, PIXELS = SHAPE_PIXELS };

typedef shape_picture planes;

static planes a, b;

static dist_images all_planes(planes *p)
{
    memset(p, 0x5a, sizeof *p);
    return shape_planes(p);
}

static dist_render_desc plain_how(void)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    return how;
}

static test_shape some_shape(int k)
{
    if (k == 0) return shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
    if (k == 1) return shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    return shape_make(SHAPE_BOX, 0.4, 0.5, 0.3, 0);
}

static void normal_of(const test_shape *shape, const double p[3], double n[3])
{
    double length = 0;
    for (int k = 0; k < 3; k++) {
        double u[3] = {p[0], p[1], p[2]}, v[3] = {p[0], p[1], p[2]};
        u[k] += 1e-6;
        v[k] -= 1e-6;
        n[k] = (shape_exact(shape, u) - shape_exact(shape, v)) / 2e-6;
        length += n[k] * n[k];
    }
    for (int k = 0; k < 3; k++) n[k] /= sqrt(length);
}

/* ---- what the planes mean --------------------------------------------------------------------------------------- */

TEST(planes_mean_what_the_interface_says)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    dist_render_desc how = plain_how();
    how.background = -7.5f;
    for (int k = 0; k < 3; k++) {
        test_shape shape = some_shape(k);
        dist_field field = shape_field(&shape, 1, 1);
        dist_images out = all_planes(&a);
        int hits = 0;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        for (int i = 0; i < SIDE * SIDE; i++) {
            double o[3], d[3], z = shape_pixel(&camera, i % SIDE, i / SIDE, o, d);
            const float *n = a.normal + 3 * i;
            double length = shape_length((double)n[0], (double)n[1], (double)n[2]);
            CHECK_EQUAL(a.status[i] == DIST_RAY_HIT, a.mask[i]);
            CHECK((a.silhouette[i] < 0) == a.mask[i]);
            if (a.mask[i]) {
                hits++;
                CHECK_NEAR(z * (double)a.distance[i], a.depth[i], 1e-6);
                CHECK(fabs(shape_along(&shape, o, d, (double)a.distance[i])) < 6e-5);
                CHECK_NEAR(1, length, 1e-5);
                CHECK(a.error[i] >= 0 && test_finite((double)a.error[i]));
            } else {
                int placed = a.status[i] == DIST_RAY_UNRESOLVED; /* the best sample, and how far from it is unknown */
                CHECK_NEAR(placed ? z * (double)a.distance[i] : -7.5, a.depth[i], 1e-6);
                if (placed) CHECK(a.distance[i] > 1 && a.distance[i] < 4 && a.error[i] > 0 && a.error[i] < 2.001f);
                else CHECK(a.distance[i] <= -7.5f && a.distance[i] >= -7.5f && a.error[i] <= 0);
                CHECK_NEAR(0, length, 0);
                CHECK(a.silhouette[i] > 0);
            }
        }
        CHECK(hits > 500);
        CHECK_EQUAL(hits, a.stats.hits);
    }
    dist_context_destroy(ctx);
}

TEST(planes_left_out_are_not_touched_and_cost_nothing)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    test_shape shape = some_shape(1);
    dist_field field = shape_field(&shape, 1, 1);
    dist_images full = all_planes(&a);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &full, NULL), ctx);
    long queries = shape.queries, gradients = shape.gradients;
    CHECK(a.stats.queries == (unsigned long long)queries);
    CHECK(a.stats.normal_queries == (unsigned long long)gradients && gradients > 0);
    unsigned long long march = a.stats.queries - a.stats.normal_queries - a.stats.silhouette_queries;
    for (int k = 0; k < 8; k++) {
        dist_images out = all_planes(&b), none;
        planes *fresh = &b;
        memset(&none, 0, sizeof none);
        none.stats = &b.stats;
        if (k == 0) none.depth = out.depth;
        if (k == 1) none.distance = out.distance;
        if (k == 2) none.normal = out.normal;
        if (k == 3) none.silhouette = out.silhouette;
        if (k == 4) none.mask = out.mask;
        if (k == 5) none.status = out.status;
        if (k == 6) none.error = out.error;
        shape.queries = shape.gradients = 0;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &none, NULL), ctx);
        CHECK(b.stats.normal_queries == (k == 2 ? a.stats.normal_queries : 0));
        CHECK(b.stats.silhouette_queries == (k == 3 ? a.stats.silhouette_queries : 0));
        CHECK(b.stats.queries == march + b.stats.normal_queries + b.stats.silhouette_queries);
        CHECK(b.stats.queries == (unsigned long long)shape.queries);
        const unsigned char *bytes = (const unsigned char *)fresh, *first = NULL;
        size_t size = 0, touched = 0;
        if (k == 0)
            first = (const unsigned char *)b.depth, size = sizeof(float) * SIDE * SIDE,
            CHECK_BYTES(size, a.depth, b.depth);
        if (k == 1)
            first = (const unsigned char *)b.distance, size = sizeof(float) * SIDE * SIDE,
            CHECK_BYTES(size, a.distance, b.distance);
        if (k == 2)
            first = (const unsigned char *)b.normal, size = sizeof(float) * 3 * SIDE * SIDE,
            CHECK_BYTES(size, a.normal, b.normal);
        if (k == 3)
            first = (const unsigned char *)b.silhouette, size = sizeof(float) * SIDE * SIDE,
            CHECK_BYTES(size, a.silhouette, b.silhouette);
        if (k == 4) first = b.mask, size = SIDE * SIDE, CHECK_BYTES(size, a.mask, b.mask);
        if (k == 5) first = b.status, size = SIDE * SIDE, CHECK_BYTES(size, a.status, b.status);
        if (k == 6)
            first = (const unsigned char *)b.error, size = sizeof(float) * SIDE * SIDE,
            CHECK_BYTES(size, a.error, b.error);
        for (size_t i = 0; i < offsetof(planes, stats); i++)
            touched += bytes[i] != 0x5a && !(first && bytes + i >= first && bytes + i < first + size);
        CHECK_EQUAL(0, touched);
    }
    dist_images nothing;
    memset(&nothing, 0, sizeof nothing);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &nothing, NULL), ctx);
    dist_context_destroy(ctx);
}

static void painted(void *user, int worker, size_t n, const float *points, float *color)
{
    (void)user;
    (void)worker;
    for (size_t i = 0; i < 3 * n; i++) color[i] = 0.5f + 0.5f * points[i];
}

TEST(color_is_the_fields_at_the_hit)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(48, 48);
    test_shape shape = some_shape(0);
    dist_field field = shape_field(&shape, 1, 1);
    dist_render_desc how = plain_how();
    dist_images out = all_planes(&a);
    out.color = a.color;
    CHECK_STATUS(DIST_UNSUPPORTED, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
    CHECK_TEXT("color", dist_context_message(ctx));
    dist_context_clear(ctx);
    field.color_fn = painted;
    how.background_color[0] = 0.25f;
    how.background_color[2] = 2;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
    for (int i = 0; i < 48 * 48; i++) {
        double o[3], d[3];
        shape_pixel(&camera, i % 48, i / 48, o, d);
        for (int k = 0; k < 3; k++)
            CHECK_NEAR(a.mask[i] ? 0.5 + 0.5 * (o[k] + (double)a.distance[i] * d[k]) : (double)how.background_color[k],
                       a.color[3 * i + k], 1e-6);
    }
    const dist_stats *s = &a.stats;
    CHECK(s->queries ==
          s->cone_queries + s->march_queries + s->refine_queries + s->silhouette_queries + s->normal_queries + s->hits);
    dist_context_destroy(ctx);
}

TEST(normals_are_the_closed_form_by_either_way_in_either_space)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int k = 0; k < 3; k++) {
        for (int mode = 0; mode < 2; mode++) {
            for (int space = 0; space < 2; space++) {
                test_shape shape = some_shape(k);
                dist_field field = shape_field(&shape, 1, 1);
                dist_render_desc how = plain_how();
                dist_images out = all_planes(&a);
                int hits = 0, off = 0;
                how.normal_mode = mode;
                how.normal_space = space;
                CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
                for (int i = 0; i < SIDE * SIDE; i++) {
                    double o[3], d[3], p[3], n[3], worst = 0;
                    if (!a.mask[i]) continue;
                    shape_pixel(&camera, i % SIDE, i / SIDE, o, d);
                    for (int j = 0; j < 3; j++) p[j] = o[j] + (double)a.distance[i] * d[j];
                    normal_of(&shape, p, n);
                    for (int j = 0; j < 3; j++) {
                        double expected = n[j];
                        if (space == DIST_SPACE_CAMERA) {
                            expected = 0;
                            for (int m = 0; m < 3; m++) expected += (double)camera.rotation[3 * j + m] * n[m];
                        }
                        worst = fmax(worst, fabs(expected - (double)a.normal[3 * i + j]));
                    }
                    hits++;
                    off += worst > (mode == DIST_NORMAL_DIFFERENCE ? 2e-3 : 2e-4);
                }
                CHECK(hits > 500);
                CHECK(off * 50 <= hits * (k == 2)); /* within delta of the box's edges a difference sees both faces */
                CHECK(a.stats.normal_queries == (unsigned long long)hits * (mode ? 6 : 1));
            }
        }
    }
    dist_context_destroy(ctx);
}

/* Fields that say they are cheap: predicted samples come with gradients, which serve the normals of hits within a
   sixteenth of a pixel and 12 epsilon, 6e-4: off by that over the radius of curvature, at the box's edges by a face.
   Interpolated hits, two in five of a box's, had no sample. */
TEST(normals_of_cheap_fields_come_with_the_last_samples)
{
    enum { PICTURE = 128 };
    const double worst[3] = {6e-4 / 0.6, 6e-4 / 0.2, 2e-4};
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(PICTURE, PICTURE);
    camera.fx = camera.fy = 250; /* pixels small enough to be predicted from each other */
    for (int k = 0; k < 3; k++) {
        test_shape shape = some_shape(k);
        dist_field field = shape_field(&shape, 1, 1);
        dist_images out = all_planes(&a), plain = all_planes(&b);
        int hits = 0, off = 0, beyond = 0;
        out.silhouette = plain.silhouette = plain.normal = NULL;
        field.cost = 1;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &plain, NULL), ctx);
        shape.queries = shape.gradients = 0;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < PICTURE * PICTURE; i++) {
            double o[3], d[3], p[3], n[3], apart = 0;
            CHECK_EQUAL(b.mask[i], a.mask[i]);
            if (!a.mask[i]) continue;
            shape_pixel(&camera, i % PICTURE, i / PICTURE, o, d);
            for (int j = 0; j < 3; j++) p[j] = o[j] + (double)a.distance[i] * d[j];
            normal_of(&shape, p, n);
            for (int j = 0; j < 3; j++) {
                double expected = 0;
                for (int m = 0; m < 3; m++) expected += (double)camera.rotation[3 * j + m] * n[m];
                apart += (expected - (double)a.normal[3 * i + j]) * (expected - (double)a.normal[3 * i + j]);
            }
            hits++;
            off += sqrt(apart) > worst[k] + 2e-4;
            beyond += fabs(shape_exact(&shape, p)) > (double)a.error[i] + 1e-6;
        }
        CHECK(hits > 500);
        CHECK(off * 50 <= hits * (k == 2));
        CHECK_EQUAL(0, beyond);
        CHECK(a.stats.normal_queries * 5 < a.stats.hits * 3 && shape.gradients > (long)a.stats.normal_queries);
        CHECK(a.stats.queries == (unsigned long long)shape.queries);
        CHECK(a.stats.queries <= b.stats.queries + a.stats.normal_queries);
    }
    dist_context_destroy(ctx);
}

/* 31 */
TEST(a_surface_without_slope_has_normal_zero_or_unit_and_nothing_is_nan)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(32, 32);
    for (int kind = 0; kind < 2; kind++) {
        test_shape shape = some_shape(0);
        shape.power = kind ? -1 : 3;
        dist_field field = shape_field(&shape, 1, 1);
        dist_images out = all_planes(&a);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < 32 * 32; i++) {
            const float *n = a.normal + 3 * i;
            double length = shape_length((double)n[0], (double)n[1], (double)n[2]);
            CHECK(test_finite((double)a.depth[i]) && test_finite((double)a.silhouette[i]) &&
                  test_finite((double)a.error[i]));
            CHECK(length < 1e-6 || fabs(length - 1) < 1e-5);
        }
    }
    dist_context_destroy(ctx);
}

/* ---- silhouette ------------------------------------------------------------------------------------------------- */

/* Smallest f along the part of a ray within the sphere, by 400 samples and golden sections. */
static double least_along(const test_shape *shape, const double o[3], const double d[3], double t0, double t1)
{
    double best = t0, least = 1e30, h = (t1 - t0) / 400;
    for (int i = 0; i <= 400; i++) {
        double f = shape_along(shape, o, d, t0 + i * h);
        if (f < least) least = f, best = t0 + i * h;
    }
    double low = fmax(best - h, t0), high = fmin(best + h, t1);
    for (int i = 0; i < 40; i++) {
        double u = low + 0.382 * (high - low), v = low + 0.618 * (high - low);
        if (shape_along(shape, o, d, u) < shape_along(shape, o, d, v)) high = v;
        else low = u;
    }
    return fmin(least, shape_along(shape, o, d, 0.5 * (low + high)));
}

/* Misses whose smallest f is below `reach` and whose value is off by more than 5e-3: at most `percent` of them. Where f
   has several minima along a ray, or a kinked one, the value can be that of another. */
static void check_silhouette(double reach, int percent)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int k = 0; k < 3; k++) {
        for (int cones = 0; cones < 2; cones++) {
            test_shape shape = some_shape(k);
            dist_field field = shape_field(&shape, 1, 1);
            dist_render_desc how = plain_how();
            dist_images out = all_planes(&a);
            double worst = 0;
            int misses = 0, off = 0;
            how.no_cones = cones;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
            for (int i = 0; i < SIDE * SIDE; i++) {
                double o[3], d[3], t0, t1;
                shape_pixel(&camera, i % SIDE, i / SIDE, o, d);
                if (a.mask[i] || a.status[i] != DIST_RAY_MISS || !shape_enter(o, d, 1, &t0, &t1)) continue;
                double least = least_along(&shape, o, d, t0, t1), far = fabs(least - 5e-5 - (double)a.silhouette[i]);
                if (least > reach) continue;
                misses++;
                off += far > 5e-3;
                worst = fmax(worst, far);
            }
            int good = CHECK(misses > 100) & CHECK(off * 100 <= misses * percent);
            if (!good || test_state.verbose)
                printf("    shape %d, %s: %d of %d misses off, worst %.1e\n", k, cones ? "no cones" : "cones", off,
                       misses, worst);
        }
    }
    dist_context_destroy(ctx);
}

TEST(silhouette_near_the_outline_is_the_smallest_f_on_98_of_100)
{
    check_silhouette(0.05, 2);
}

TEST(silhouette_of_misses_is_the_smallest_f_on_92_of_100)
{
    check_silhouette(10, 8);
}

static double box_along(const float box[6], const float o[3], const float d[3], double t)
{
    double square = 0, inside = -1e30;
    for (int i = 0; i < 3; i++) {
        double off = fabs((double)o[i] + t * (double)d[i] - (double)box[i]) - (double)box[3 + i];
        inside = fmax(inside, off);
        square += off > 0 ? off * off : 0;
    }
    return square > 0 ? sqrt(square) : inside;
}

/* Beside an edge f falls in a straight line along the ray, then has its least where the ray passes the edge's middle:
   what neighbors say is short of that. f is convex along rays, so that golden sections find it. */
TEST(silhouette_of_a_box_is_the_smallest_f_along_its_edges)
{
    enum { W = 384, H = 288 };
    static float silhouette[W * H];
    static unsigned char mask[W * H];
    float box[6] = {0.1f, 0, 0, 0.4f, 0.5f, 0.3f}, eye[3] = {1.4f, 1, 2}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_context *ctx = test_context();
    dist_field field = dist_field_box(box);
    for (int size = 1; size <= 4; size *= 2) {
        dist_camera camera = dist_camera_look_at(W / size, H / size, 0.8f, eye, at, up);
        dist_images out;
        int misses = 0, off = 0;
        double worst = 0;
        memset(&out, 0, sizeof out);
        out.silhouette = silhouette;
        out.mask = mask;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < camera.width * camera.height; i++) {
            float o[3], d[3];
            double low = 1, high = 5;
            dist_camera_ray(&camera, (float)(i % camera.width), (float)(i / camera.width), o, d);
            for (int k = 0; k < 60; k++) {
                double u = low + 0.382 * (high - low), v = low + 0.618 * (high - low);
                if (box_along(box, o, d, u) < box_along(box, o, d, v)) high = v;
                else low = u;
            }
            double least = box_along(box, o, d, 0.5 * (low + high)), far = fabs(least - (double)silhouette[i]);
            if (mask[i] || least > 0.03) continue;
            misses++;
            off += far > 1e-3;
            worst = fmax(worst, far);
        }
        int good = CHECK(misses > 100) & CHECK(off * 200 <= misses);
        if (!good || test_state.verbose)
            printf("    %d x %d: %d of %d misses off by more than 1e-3, worst %.1e\n", camera.width, camera.height, off,
                   misses, worst);
    }
    dist_context_destroy(ctx);
}

/* Beside thin rods each ray comes near several: the least |f| is that of the rod that the pixels around it see. From
   one pixel to the next it changes by no more than they are apart, so nothing near the outline may stand far off. */
TEST(silhouette_beside_rods_is_that_of_the_nearest_rod)
{
    enum { MOST = 256 };
    static float silhouette[MOST * MOST];
    static unsigned char mask[MOST * MOST];
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_RODS, 0.02, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    const float eye[3] = {1.4f, 1, 2}, at[3] = {0, 0, 0};
    for (int size = 64; size <= (test_quick() ? 128 : MOST); size *= 2) {
        dist_camera camera = dist_camera_look_at(size, size, 0.7f, eye, at, NULL);
        dist_images out;
        int misses = 0, off = 0, far_off = 0;
        double worst = 0;
        memset(&out, 0, sizeof out);
        out.silhouette = silhouette;
        out.mask = mask;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < size * size; i++) {
            float o[3], d[3];
            double from[3], along[3], least = 1, middle = 0;
            if (mask[i]) continue;
            dist_camera_ray(&camera, (float)(i % size), (float)(i / size), o, d);
            for (int j = 0; j < 3; j++) from[j] = (double)o[j], along[j] = (double)d[j];
            for (int j = 0; j < 200; j++) {
                double t = 1.6 + 2 * j / 200.0, f = shape_along(&shape, from, along, t);
                if (f < least) least = f, middle = t;
            }
            for (double h = 0.005; h > 1e-6; h *= 0.5)
                for (int side = -1; side <= 1; side += 2)
                    while (shape_along(&shape, from, along, middle + side * h) < least) {
                        middle += side * h;
                        least = shape_along(&shape, from, along, middle);
                    }
            if (!(least > 0 && least < 0.03)) continue;
            double error = fabs(least - (double)silhouette[i]);
            misses++;
            off += error > 2e-3;
            far_off += error > 1e-2;
            worst = fmax(worst, error);
        }
        int good = CHECK(misses > 300) & CHECK(off * 300 <= misses) & CHECK(far_off * 1000 <= misses);
        if (!good || test_state.verbose)
            printf("    %d: of %d misses %d off by more than 2e-3, %d by 1e-2, worst %.1e\n", size, misses, off,
                   far_off, worst);
    }
    dist_context_destroy(ctx);
}

static void clamped_ball(void *user, int worker, size_t n, const float *p, float *sdf, float *gradient)
{
    (void)user, (void)worker;
    for (size_t i = 0; i < n; i++, p += 3) {
        float x = p[0] - 0.05f, y = p[1] - 0.02f, z = p[2] + 0.03f, r = sqrtf(x * x + y * y + z * z), f = r - 0.5f;
        int flat = f > 0.1f || f < -0.1f;
        sdf[i] = flat ? (f > 0 ? 0.1f : -0.1f) : f;
        const float away[3] = {x / r, y / r, z / r};
        for (size_t k = 0; gradient && k < 3; k++) gradient[3 * i + k] = flat ? 0.0f : away[k];
    }
}

/* On the plateau no sample is less than another, so that none says where to look. */
TEST(silhouette_of_a_clamped_field_is_seen_from_the_plateau)
{
    dist_context *ctx = shape_context();
    float eye[3] = {1.4f, 1.0f, 2.0f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(128, 128, 0.75f, eye, at, up);
    dist_field field;
    float *plane = (float *)malloc(128 * 128 * sizeof(float));
    unsigned char *mask = (unsigned char *)malloc(128 * 128);
    int near = 0, off = 0;
    memset(&field, 0, sizeof field);
    field.eval_fn = clamped_ball;
    field.radius = field.lipschitz = 1.0f;
    field.clamp = 0.1f;
    dist_images out;
    memset(&out, 0, sizeof out);
    out.silhouette = plane;
    out.mask = mask;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
    for (int i = 0; i < 128 * 128; i++) {
        float o[3], d[3];
        double e[3], along = 0, square = 0;
        dist_camera_ray(&camera, (float)(i % 128), (float)(i / 128), o, d);
        for (int k = 0; k < 3; k++) {
            e[k] = (double)o[k] - (k == 0 ? 0.05 : k == 1 ? 0.02 : -0.03);
            along += e[k] * (double)d[k];
            square += e[k] * e[k];
        }
        double least = sqrt(square - along * along) - 0.5;
        if (mask[i] || least > 0.095) continue;
        near++;
        off += fabs((double)plane[i] - least) > (least < 0.05 ? 1e-3 : 1e-2);
    }
    CHECK(near > 1000);
    CHECK(off <= 2);
    free(plane), free(mask);
    dist_context_destroy(ctx);
}

/* 36 */
TEST(silhouette_off_the_sphere_is_the_distance_to_it)
{
    dist_context *ctx = shape_context();
    float eye[3] = {0, 0, 10}, at[3] = {4, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(64, 48, 0.8f, eye, at, up);
    test_shape shape = some_shape(0);
    dist_field field = shape_field(&shape, 1, 1);
    for (int paper = 0; paper < 2; paper++) {
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a);
        int outside = 0;
        how.trace = paper ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        for (int i = 0; i < 64 * 48; i++) {
            double o[3], d[3], along = 0;
            shape_pixel(&camera, i % 64, i / 64, o, d);
            for (int k = 0; k < 3; k++) along -= o[k] * d[k];
            double off = shape_length(o[0] + along * d[0], o[1] + along * d[1], o[2] + along * d[2]) - 1;
            if (off < 1e-6) continue;
            outside++;
            CHECK_NEAR(off, a.silhouette[i], 1e-6 * (1 + off));
            CHECK_EQUAL(DIST_RAY_MISS, a.status[i]);
        }
        CHECK(outside > 1000);
    }
    dist_context_destroy(ctx);
}

/* Prediction also pays where pixels are a 50th to a 100th of the radius: smaller pictures never ask for more. */
TEST(a_smaller_picture_asks_for_less)
{
    dist_context *ctx = shape_context();
    dist_net *net = dist_net_load_file(ctx, "examples/model.safetensors");
    float eye[3] = {1.14f, 0.93f, 1.63f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    static const int codes[3] = {5, 70, 200}, sizes[4] = {512, 288, 256, 160};
    float *depth = (float *)malloc(512 * 512 * sizeof(float)), *exact = (float *)malloc(512 * 512 * sizeof(float));
    for (int k = 0; k < 3; k++) {
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, codes[k]));
        dist_field field = dist_shape_field(shape);
        unsigned long long last = ~0ull;
        for (int j = 0; j < 4; j++) {
            dist_camera camera = dist_camera_look_at(sizes[j], sizes[j], 1.174f, eye, at, up);
            dist_stats stats, alone;
            dist_render_desc how = plain_how();
            dist_images out;
            int hits = 0, other = 0;
            memset(&out, 0, sizeof out);
            out.depth = depth, out.stats = &stats;
            how.epsilon = 0.0f;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
            CHECK(stats.queries < last);
            last = stats.queries;
            if (j == 0) continue;
            out.depth = exact, out.stats = &alone;
            how.no_prediction = 1;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
            CHECK(10 * stats.queries < 6 * alone.queries);
            for (int i = 0; i < sizes[j] * sizes[j]; i++) {
                hits += exact[i] > 0.0f;
                other += fabs((double)exact[i] - (double)depth[i]) > 5e-5;
            }
            CHECK(hits > 1000);
            CHECK(100 * other < hits);
            if (test_state.verbose)
                printf("    %d pixels: %llu queries, alone %llu; %d of %d hits differ\n", sizes[j], stats.queries,
                       alone.queries, other, hits);
        }
        dist_shape_destroy(shape);
    }
    dist_net_destroy(net), dist_context_destroy(ctx);
    free(depth), free(exact);
}

/* 34: the outline moves over pixels, the value goes through 0 without a jump. */
TEST(silhouette_is_continuous_and_the_mask_changes_by_single_pixels)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(1, 64);
    double last[64];
    unsigned char mask[64];
    int changes = 0, jumps = 0;
    camera.fx = camera.fy = 60;
    camera.cy = 31.5f;
    for (int k = 0; k < 200; k++) {
        test_shape shape = shape_make(SHAPE_SPHERE, 0.5 + 4e-4 * k, 0, 0, 0);
        dist_field field = shape_field(&shape, 1, 1);
        dist_images out = all_planes(&a);
        int moved = 0;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < 64; i++) {
            if (k > 0) moved += a.mask[i] != mask[i];
            if (k > 0 && a.silhouette[i] < 0.1f) jumps += fabs((double)a.silhouette[i] - last[i]) > 2e-3;
            last[i] = (double)a.silhouette[i];
            mask[i] = a.mask[i];
        }
        CHECK(moved <= 2);
        changes += moved;
    }
    CHECK_EQUAL(0, jumps);
    CHECK(changes >= 1);
    /* one ulp of the pose */
    test_shape shape = some_shape(0);
    dist_field field = shape_field(&shape, 1, 1);
    for (int k = 0; k < 40; k++) {
        dist_images out = all_planes(&a), again = all_planes(&b);
        int moved = 0;
        dist_camera other = camera;
        other.translation[0] = nextafterf(camera.translation[0], 10);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &other, NULL, &again, NULL), ctx);
        for (int i = 0; i < 64; i++) moved += a.mask[i] != b.mask[i];
        CHECK(moved <= 1);
        camera.translation[0] += 0.0007f;
    }
    dist_context_destroy(ctx);
}

/* ---- size, scale, distance -------------------------------------------------------------------------------------- */

/* 12 */
TEST(scale_of_the_world_changes_nothing)
{
    dist_context *ctx = shape_context();
    const double scales[4] = {1e-6, 1e-3, 1e3, 1e6};
    dist_camera camera = shape_camera(48, 48);
    float unit[5] = {0, 0, 0, 0.6f, 0.2f}, numbers[5];
    dist_field field = dist_field_torus(unit);
    dist_images out = all_planes(&a);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
    for (int k = 0; k < 4; k++) {
        dist_camera far = camera;
        dist_images other = all_planes(&b);
        int masks = 0, off = 0;
        for (int i = 0; i < 5; i++) numbers[i] = (float)((double)unit[i] * scales[k]);
        for (int i = 0; i < 3; i++) far.translation[i] = (float)((double)camera.translation[i] * scales[k]);
        field = dist_field_torus(numbers);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &far, NULL, &other, NULL), ctx);
        for (int i = 0; i < 48 * 48; i++) {
            masks += a.mask[i] != b.mask[i];
            if (!a.mask[i] || !b.mask[i]) continue;
            off += fabs((double)b.depth[i] / scales[k] - (double)a.depth[i]) >
                   1e-5 + (double)a.error[i] + (double)b.error[i] / scales[k];
            for (int j = 0; j < 3; j++) off += fabs((double)(a.normal[3 * i + j] - b.normal[3 * i + j])) > 1e-3;
        }
        CHECK_EQUAL(0, off);
        CHECK(masks <= 1);
        if (test_state.verbose) printf("    scale %g: %d masks differ, %d values off\n", scales[k], masks, off);
    }
    dist_context_destroy(ctx);
}

/* 11 */
TEST(far_cameras_see_what_double_sees)
{
    dist_context *ctx = shape_context();
    const double away[3] = {1e2, 1e4, 1e6};
    for (int k = 0; k < 3; k++) {
        double length = shape_length(1.4, 1, 2);
        float eye[3] = {(float)(away[k] * 1.4 / length), (float)(away[k] / length), (float)(away[k] * 2 / length)};
        float at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
        dist_camera camera = dist_camera_look_at(64, 64, (float)(2.2 / away[k]), eye, at, up);
        test_shape shape = some_shape(1);
        dist_field field = shape_field(&shape, 1, 1);
        dist_images out = all_planes(&a);
        int wrong = 0, hits = 0, outline = 0;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < 64 * 64; i++) {
            double o[3], d[3], t0, t1;
            shape_pixel(&camera, i % 64, i / 64, o, d);
            if (!shape_enter(o, d, 1, &t0, &t1)) {
                wrong += a.mask[i];
                continue;
            }
            shape_crossing c = shape_cross(&shape, o, d, t0, t1, 1, 1e-5, 1e-4);
            if (c.touched || (c.crosses && c.below < 1e-5) || (!c.crosses && c.least < 1e-4)) {
                outline++;
                continue;
            }
            wrong += c.crosses != a.mask[i];
            if (!c.crosses || !a.mask[i]) continue;
            hits++;
            CHECK_NEAR(c.t, a.distance[i], (double)a.error[i] + 2e-6 / fmax(fabs(c.slope), 0.05) + 6e-8 * c.t);
        }
        CHECK_EQUAL(0, wrong);
        CHECK(hits > 500 && outline < 40);
    }
    dist_context_destroy(ctx);
}

/* 13 */
TEST(focal_lengths_from_a_thousandth_to_a_million_are_finite)
{
    dist_context *ctx = shape_context();
    const float focal[6] = {1e-3f, 1e-1f, 1, 1e3f, 1e5f, 1e6f};
    for (int k = 0; k < 6; k++) {
        dist_camera camera = shape_camera(40, 30);
        test_shape shape = some_shape(0);
        dist_field field = shape_field(&shape, 1, 1);
        dist_images out = all_planes(&a);
        camera.fx = camera.fy = focal[k];
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        int wrong = 0;
        for (int i = 0; i < 40 * 30; i++) {
            double o[3], d[3], along = 0;
            CHECK(test_finite((double)a.depth[i]) && test_finite((double)a.distance[i]) &&
                  test_finite((double)a.silhouette[i]));
            CHECK(test_finite((double)a.normal[3 * i]) && test_finite((double)a.error[i]) &&
                  a.status[i] != DIST_RAY_NOT_FINITE);
            shape_pixel(&camera, i % 40, i / 40, o, d);
            CHECK_NEAR(1, shape_length(d[0], d[1], d[2]), 1e-12);
            for (int j = 0; j < 3; j++) along -= o[j] * d[j];
            double off = shape_length(o[0] + along * d[0], o[1] + along * d[1], o[2] + along * d[2]) - 0.6;
            if (fabs(off) > 1e-4) wrong += (off < 0 && along > 0) != a.mask[i];
        }
        CHECK_EQUAL(0, wrong);
    }
    dist_context_destroy(ctx);
}

/* 25, 26, 27: every pixel of a picture of any shape is the same as by itself. */
TEST(pictures_of_any_shape_agree_with_single_pixels)
{
    dist_context *ctx = shape_context();
    const int sizes[10][2] = {{1, 1},   {1, 4096}, {4096, 1}, {2, 3},    {5, 7},
                              {31, 33}, {33, 31},  {65, 2},   {63, 129}, {97, 1}};
    for (int k = 0; k < 10; k++) {
        int w = sizes[k][0], h = sizes[k][1], step = 1 + w * h / 150;
        float eye[3] = {1.2f, 0.9f, 1.8f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
        dist_camera camera = dist_camera_look_at(w, h, 0.8f, eye, at, up);
        test_shape shape = some_shape(1);
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a);
        int wrong = 0, hits = 0;
        camera.fx = 0.9f * (float)(w > 8 ? w : 8);
        camera.fy = 1.1f * (float)(h > 8 ? h : 8);
        camera.skew = 0.3f;
        camera.cx += 0.1f * (float)w;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < w * h; i += step) {
            dist_camera one = camera;
            dist_images single = all_planes(&b);
            double o[3], d[3], t0, t1;
            one.width = one.height = 1;
            one.cx -= (float)(i % w);
            one.cy -= (float)(i / w);
            how.no_cones = 1;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &one, &how, &single, NULL), ctx);
            shape_pixel(&camera, i % w, i / w, o, d);
            hits += a.mask[i];
            if (a.mask[i] && b.mask[0]) {
                wrong += fabs((double)a.distance[i] - (double)b.distance[0]) >
                         (double)a.error[i] + (double)b.error[0] + 2e-5;
            } else if (a.mask[i] != b.mask[0]) {
                shape_crossing c;
                memset(&c, 0, sizeof c);
                if (shape_enter(o, d, 1, &t0, &t1)) c = shape_cross(&shape, o, d, t0, t1, 1, 1e-5, 1e-4);
                wrong += !(c.touched || (c.crosses && c.below < 1e-4) || (!c.crosses && c.least < 1e-4));
            }
        }
        CHECK_EQUAL(0, wrong);
        CHECK(hits > 0 || w * h < 40);
    }
    dist_context_destroy(ctx);
}

TEST(a_picture_and_its_crop_agree)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(90, 70), crop = camera;
    test_shape shape = some_shape(2);
    dist_field field = shape_field(&shape, 1, 1);
    for (int cones = 0; cones < 2; cones++) {
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a), part = all_planes(&b);
        int off = 0, masks = 0;
        how.no_cones = cones;
        crop.width = 37;
        crop.height = 29;
        crop.cx = camera.cx - 30;
        crop.cy = camera.cy - 21;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &crop, &how, &part, NULL), ctx);
        for (int i = 0; i < 37 * 29; i++) {
            int j = (21 + i / 37) * 90 + 30 + i % 37;
            masks += a.mask[j] != b.mask[i];
            if (a.mask[j] && b.mask[i])
                off += fabs((double)(a.distance[j] - b.distance[i])) > (double)a.error[j] + (double)b.error[i] + 1e-6;
        }
        CHECK_EQUAL(0, off);
        CHECK(masks <= 1);
    }
    dist_context_destroy(ctx);
}

/* 25: the largest picture is refused by memory, not by an overflow. */
TEST(huge_tapes_are_refused_or_had_without_overflow)
{
    test_allocator allocator;
    memset(&allocator, 0, sizeof allocator);
    dist_context_desc desc = test_context_desc();
    desc.workers = 1;
    desc.allocator = test_allocator_hook(&allocator);
    dist_context *ctx = dist_context_create(&desc);
    dist_camera camera = shape_camera(65536, 65536);
    dist_render_desc how = plain_how();
    how.trace = DIST_TRACE_PAPER;
    how.samples = 8;
    allocator.fail_at = allocator.requests + 3; /* partial sums, tape, then its planes: 133 bytes a pixel */
    allocator.fail_onwards = 1;
    CHECK(dist_tape_create(ctx, &camera, &how) == NULL);
    CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_context_status(ctx), ctx);
    CHECK_TEXT("dist_tape_create: out of memory", dist_context_message(ctx));
    CHECK_TEXT(sizeof(size_t) > 4 ? "57123" : "out of memory", dist_context_message(ctx));
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, allocator.live_blocks);
}

/* ---- the same bits ---------------------------------------------------------------------------------------------- */

/* 40 */
TEST(workers_and_order_of_tasks_change_no_bit)
{
    const int workers[5] = {1, 2, 3, 7, 64};
    dist_net_desc net_desc;
    memset(&net_desc, 0, sizeof net_desc);
    net_desc.layers = 3;
    net_desc.width = 24;
    net_desc.code_size = 4;
    net_desc.geometric = 1;
    net_desc.seed = 7;
    dist_render_desc how = plain_how();
    static planes first;
    for (int paper = 0; paper < 2; paper++) {
        how.trace = paper ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        for (int k = 0; k < 5; k++) {
            test_scheduler scheduler;
            dist_context_desc desc = test_context_desc();
            scheduler.workers = workers[k];
            scheduler.calls = k;
            desc.workers = workers[k];
            if (k > 0) desc.scheduler = test_scheduler_hook(&scheduler);
            dist_context *ctx = dist_context_create(&desc);
            dist_net *net = dist_net_create(ctx, &net_desc);
            dist_shape *shape = dist_shape_create(ctx, net, NULL);
            dist_field field = dist_shape_field(shape);
            dist_camera camera = shape_camera(90, 75);
            dist_images out = all_planes(k ? &b : &first);
            if (k == 0 && !paper) memset(&a, 0, sizeof a);
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
            CHECK_EQUAL(workers[k], dist_context_workers(ctx));
            if (k > 0) CHECK_BYTES(offsetof(planes, stats), &first, &b);
            if (k > 0) CHECK_BYTES(sizeof(dist_stats), &first.stats, &b.stats);
            else CHECK(first.stats.hits > 100);
            dist_shape_destroy(shape);
            dist_net_destroy(net);
            dist_context_destroy(ctx);
        }
    }
}

/* ---- counts ----------------------------------------------------------------------------------------------------- */

TEST(counts_add_up)
{
    dist_context *ctx = shape_context();
    for (int k = 0; k < 12; k++) {
        dist_camera camera = shape_camera(64, 48);
        test_shape shape = some_shape(k % 3);
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a);
        unsigned long long seen[6] = {0, 0, 0, 0, 0, 0}, hits = 0, met = 0;
        float error = 0;
        how.trace = k >= 9 ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        how.max_steps = k >= 3 && k < 6 ? 8 : 0;
        if (k >= 6 && k < 9)
            camera = dist_camera_look_at(64, 48, 1.5f, (const float[3]){0.3f, 0.1f, 0.2f}, (const float[3]){1, 0, 0},
                                         (const float[3]){0, 1, 0});
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        for (int i = 0; i < 64 * 48; i++) {
            double o[3], d[3], t0, t1;
            if (CHECK(a.status[i] <= DIST_RAY_NOT_FINITE)) seen[a.status[i]]++;
            hits += a.mask[i];
            if (a.status[i] == DIST_RAY_HIT && a.error[i] > error) error = a.error[i];
            shape_pixel(&camera, i % 64, i / 64, o, d);
            met += (unsigned)shape_enter(o, d, 1, &t0, &t1);
        }
        const dist_stats *s = &a.stats;
        CHECK_EQUAL(64 * 48, s->rays);
        CHECK(s->rays_in_sphere + 2 >= met && met + 2 >= s->rays_in_sphere);
        CHECK_EQUAL(hits, s->hits);
        CHECK_EQUAL(seen[DIST_RAY_UNRESOLVED], s->unresolved);
        CHECK_EQUAL(seen[DIST_RAY_INSIDE], s->inside);
        CHECK_EQUAL(seen[DIST_RAY_PLATEAU], s->plateau);
        CHECK_EQUAL(seen[DIST_RAY_NOT_FINITE], s->not_finite);
        CHECK_EQUAL(s->queries,
                    s->cone_queries + s->march_queries + s->refine_queries + s->silhouette_queries + s->normal_queries);
        CHECK_EQUAL(shape.queries, s->queries);
        CHECK_NEAR(error, s->error, 0);
        CHECK_NEAR(1, s->lipschitz, 0);
        CHECK(s->epsilon > 0 && s->epsilon <= 5.1e-5f);
        CHECK_NEAR(0, s->operations, 0);
        CHECK(s->capped == 0 && s->backward_points == 0 && s->skipped == 0);
        if (k >= 3 && k < 6) CHECK(s->unresolved > 0);
    }
    dist_context_destroy(ctx);
}

TEST(operations_done_are_no_more_than_a_dense_net_would_do)
{
    dist_context *ctx = shape_context();
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 4;
    desc.width = 64;
    desc.geometric = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    dist_camera camera = shape_camera(48, 48);
    dist_images out = all_planes(&a);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
    CHECK(a.stats.hits > 50);
    CHECK(a.stats.operations > 0 && a.stats.operations_done > 0);
    CHECK(a.stats.operations_done <= a.stats.operations);
    CHECK(a.stats.operations >= (double)a.stats.queries * (double)dist_net_operations(net, 1) * 0.999);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* ---- refusals, inside, NaN -------------------------------------------------------------------------------------- */

TEST(a_tape_is_for_its_size_and_trace)
{
    dist_context *ctx = shape_context(), *other = shape_context();
    dist_camera camera = shape_camera(16, 12), wide = shape_camera(12, 16);
    test_shape shape = some_shape(0);
    float sphere[4] = {0, 0, 0, 0.5f};
    dist_field field = shape_field(&shape, 1, 1);
    dist_render_desc paper = plain_how(), more = plain_how();
    paper.trace = more.trace = DIST_TRACE_PAPER;
    more.samples = 3;
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL), *paper_tape = dist_tape_create(ctx, &camera, &paper);
    dist_images out = all_planes(&a);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, tape), ctx);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &paper, &out, paper_tape), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &wide, NULL, &out, tape), ctx);
    CHECK_TEXT("size", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &camera, &paper, &out, tape), ctx);
    CHECK_TEXT("trace", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &camera, &more, &out, paper_tape), ctx);
    CHECK_TEXT("samples", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(other, &field, &camera, NULL, &out, tape), other);
    CHECK_TEXT("another context", dist_context_message(other));
    dist_render_desc warm = plain_how();
    warm.warm_start = 1;
    for (int k = 0; k < 2; k++) {
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &camera, &warm, &out, k ? tape : NULL), ctx);
        CHECK_TEXT(k ? "how.warm_start is 1, but tape is not made with it" : "how.warm_start is 1, but tape is NULL",
                   dist_context_message(ctx));
        dist_context_clear(ctx);
    }
#ifndef DIST_NO_BACKWARD
    static float d_silhouette[16 * 12];
    float d_code[4] = {0, 0, 0, 0}, point[3] = {0, 0, 0};
    dist_images d_out;
    dist_gradients grads;
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    d_out.silhouette = d_silhouette;
    grads.code = d_code;
    field = dist_field_sphere(sphere);
    out.silhouette = NULL;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, tape), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
    CHECK_TEXT("d_out.silhouette is given, but out.silhouette was NULL", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_backward(ctx, &field, 1, point, NULL, NULL, NULL, NULL, &grads), ctx);
    CHECK_TEXT("dist_field_backward: d_sdf is NULL, needed without seed_fn", dist_context_message(ctx));
#endif
    dist_tape_destroy(tape);
    dist_tape_destroy(paper_tape);
    dist_tape_destroy(NULL);
    dist_context_destroy(ctx);
    dist_context_destroy(other);
}

TEST(a_field_without_adjoint_renders_but_its_gradient_is_refused)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(16, 12);
    test_shape shape = some_shape(0);
    dist_field field = shape_field(&shape, 1, 1);
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
    dist_images out = all_planes(&a), d_out;
    dist_gradients grads;
    float d_depth[16 * 12], d_code[4] = {1, 2, 3, 4}, rotation[3] = {0, 0, 0};
    for (int i = 0; i < 16 * 12; i++) d_depth[i] = 1;
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    d_out.depth = d_depth;
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render_backward(ctx, tape, &d_out, &grads), ctx); /* not rendered yet */
    CHECK_TEXT("dist_render_backward: tape is empty", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, tape), ctx);
    grads.code = d_code;
    for (int k = 0; k < 2; k++) {
        field.code_size = k ? 4 : 0;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, tape), ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
        CHECK_TEXT("adjoint_fn", dist_context_message(ctx));
        dist_context_clear(ctx);
    }
    CHECK(d_code[0] == 1 && d_code[3] == 4);
    grads.code = NULL;
    grads.weights = d_code;
    CHECK_STATUS(DIST_UNSUPPORTED, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
    CHECK_TEXT("weights", dist_context_message(ctx));
    dist_context_clear(ctx);
    grads.weights = NULL;
    grads.rotation = rotation; /* the camera's needs grad f alone */
    CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
    CHECK(rotation[0] != 0);
    dist_tape_destroy(tape);
    dist_context_destroy(ctx);
}

TEST(render_refuses_null_and_garbage_with_a_sentence)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(8, 8);
    test_shape shape = some_shape(0);
    const uint32_t nan = 0x7fc00000u;
    for (int k = 0; k < 8; k++) {
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a);
        const char *part = "field";
        if (k == 2) field.radius = -1, part = "radius";
        if (k == 3) field.lipschitz = -1, part = "lipschitz";
        if (k == 4) how.paper_row = 4, part = "paper_row";
        if (k == 5) how.gradient_cap = 2, part = "gradient_cap";
        if (k == 6) how.normal_space = -1, part = "normal_space";
        if (k == 7) part = "out is NULL";
        if (k == 1) field.eval_fn = NULL;
        dist_context_clear(ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, k ? &field : NULL, &camera, &how, k == 7 ? NULL : &out, NULL),
                     ctx);
        CHECK_TEXT("dist_render: ", dist_context_message(ctx));
        CHECK_TEXT(part, dist_context_message(ctx));
        CHECK_EQUAL(0x5a, a.mask[0]);
    }
    for (int k = 0; k < 7; k++) { /* where no range tells it, a status of its own */
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a);
        static const char *const sentences[7] = {
            "how.background is nan", "how.background_color[2] is nan", "field.radius is nan", "field.center[1] is nan",
            "field.lipschitz is nan", "how.epsilon is nan", "how.normal_delta is nan"};
        float *const places[7] = {&how.background, &how.background_color[2], &field.radius, &field.center[1],
                                  &field.lipschitz, &how.epsilon, &how.normal_delta};
        memcpy(places[k], &nan, sizeof nan);
        dist_context_clear(ctx);
        dist_status status = dist_render(ctx, &field, &camera, &how, &out, NULL);
        CHECK_STATUS(k < 2 ? DIST_NOT_FINITE : DIST_BAD_ARGUMENT, status, ctx);
        CHECK_TEXT(sentences[k], dist_context_message(ctx));
        CHECK_EQUAL(0x5a, a.mask[0]);
    }
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_render(NULL, NULL, NULL, NULL, NULL, NULL));
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_render_backward(NULL, NULL, NULL, NULL));
    dist_context_destroy(ctx);
}

/* 8 */
TEST(inside_modes_are_what_the_desc_says)
{
    dist_context *ctx = shape_context();
    float eye[3] = {0.1f, 0.2f, -0.1f}, at[3] = {1, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(32, 24, 1.2f, eye, at, up);
    for (int mode = 0; mode < 3; mode++) {
        test_shape shape = some_shape(0);
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a);
        how.inside = mode;
        how.background = 9;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        for (int i = 0; i < 32 * 24; i++) {
            double o[3], d[3], along = 0;
            shape_pixel(&camera, i % 32, i / 32, o, d);
            for (int k = 0; k < 3; k++) along -= o[k] * d[k];
            double off = shape_length(o[0] + along * d[0], o[1] + along * d[1], o[2] + along * d[2]);
            double exit = along + sqrt(0.36 - off * off);
            CHECK_EQUAL(mode == DIST_INSIDE_EXIT ? DIST_RAY_HIT : DIST_RAY_INSIDE, a.status[i]);
            CHECK_EQUAL(mode != DIST_INSIDE_BACKGROUND, a.mask[i]);
            CHECK((a.silhouette[i] < 0) == a.mask[i]);
            double start = shape_value(&shape, o); /* what its gradient is that of */
            if (mode == DIST_INSIDE_HIT) CHECK_NEAR(start, (double)a.silhouette[i], 1e-4);
            double expected = mode == DIST_INSIDE_BACKGROUND ? 9 : mode == DIST_INSIDE_HIT ? 0 : exit;
            CHECK_NEAR(expected, a.distance[i], mode == DIST_INSIDE_HIT ? 0 : (double)a.error[i] + 1e-6);
        }
    }
    dist_context_destroy(ctx);
}

/* 22 */
TEST(nan_from_the_field_spoils_only_its_pixels)
{
    dist_context *ctx = shape_context();
    float eye[3] = {0, 0, 2.4f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(64, 64, 0.9f, eye, at, up);
    for (int k = 0; k < 4; k++) {
        test_shape shape = some_shape(0);
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a), spoilt = all_planes(&b);
        how.trace = k / 2;
        how.normal_mode = k % 2;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        shape.poison = 0.2;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &spoilt, NULL), ctx);
        int bad = 0, changed = 0;
        for (int i = 0; i < 64 * 64; i++) {
            double o[3], d[3], along = 0;
            CHECK(test_finite((double)b.depth[i]) && test_finite((double)b.distance[i]) &&
                  test_finite((double)b.silhouette[i]));
            CHECK(test_finite((double)b.error[i]) && test_finite((double)b.normal[3 * i]) &&
                  test_finite((double)b.normal[3 * i + 2]));
            if (b.status[i] == DIST_RAY_NOT_FINITE) {
                bad++;
                CHECK_EQUAL(0, b.mask[i]);
                continue;
            }
            shape_pixel(&camera, i % 64, i / 64, o, d);
            for (int j = 0; j < 3; j++) along += ((j == 2 ? 0.5 : 0) - o[j]) * d[j];
            double off = shape_length(o[0] + along * d[0], o[1] + along * d[1], o[2] + along * d[2] - 0.5);
            changed += off > 0.21 && (a.mask[i] != b.mask[i] || fabs((double)(a.depth[i] - b.depth[i])) > 1e-4);
        }
        CHECK(bad > 50);
        CHECK_EQUAL(bad, b.stats.not_finite);
        if (k < 2) CHECK_EQUAL(0, changed); /* the paper's coarse rays pass on what they met */
    }
    dist_context_destroy(ctx);
}

/* 20 */
TEST(dead_fields_are_all_miss_all_inside_or_plateau)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(24, 24);
    const double values[3] = {0.5, -0.5, 0};
    const int status[3] = {DIST_RAY_MISS, DIST_RAY_INSIDE, DIST_RAY_PLATEAU};
    for (int k = 0; k < 3; k++) {
        test_shape shape = shape_make(SHAPE_CONSTANT, values[k], 0, 0, 0);
        dist_field field = shape_field(&shape, 1, 1);
        dist_images out = all_planes(&a);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < 24 * 24; i++) {
            double o[3], d[3], t0, t1;
            shape_pixel(&camera, i % 24, i / 24, o, d);
            CHECK_EQUAL(0, a.mask[i]);
            CHECK_EQUAL(shape_enter(o, d, 1, &t0, &t1) ? status[k] : DIST_RAY_MISS, a.status[i]);
            CHECK(a.silhouette[i] > 0 && test_finite((double)a.silhouette[i]));
        }
    }
    dist_context_destroy(ctx);
}

/* ---- only what is looked at -------------------------------------------------------------------------------------- */

static void check_not_asked(const planes *p, int i, const dist_render_desc *how)
{
    CHECK_EQUAL(DIST_RAY_SKIPPED, p->status[i]);
    CHECK_EQUAL(0, p->mask[i]);
    CHECK_NEAR((double)how->background, (double)p->depth[i], 0.0);
    CHECK_NEAR(0.0, (double)p->silhouette[i], 0.0);
    CHECK_NEAR(0.0, (double)p->normal[3 * i], 0.0);
}

TEST(twenty_points_cost_no_more_than_their_twenty_rays)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int k = 0; k < 3; k++) {
        test_shape shape = some_shape(k);
        dist_field field = shape_field(&shape, 1, 1);
        static unsigned char pixels[SIDE * SIDE];
        dist_render_desc how = plain_how();
        unsigned long long alone = 0;
        how.background = 3;
        how.no_cones = 1;
        dist_images out = all_planes(&a);
        out.color = NULL;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        how.no_cones = 0;
        memset(pixels, 0, sizeof pixels);
        out = all_planes(&b);
        out.color = NULL;
        out.normal = out.silhouette = NULL;
        for (int i = 0; i < 20; i++) { /* each alone */
            memset(pixels, 0, sizeof pixels);
            pixels[(i * 997 + 41 * k + SIDE * 20) % (SIDE * SIDE)] = 1;
            how.pixels = pixels;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
            CHECK_EQUAL(1, b.stats.rays);
            alone += b.stats.queries;
        }
        for (int i = 0; i < 20; i++) pixels[(i * 997 + 41 * k + SIDE * 20) % (SIDE * SIDE)] = (unsigned char)(i + 1);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        CHECK_EQUAL(20, b.stats.rays);
        CHECK_EQUAL(alone, b.stats.queries);
        CHECK_EQUAL(0, b.stats.cone_queries + b.stats.normal_queries + b.stats.silhouette_queries);
        memset(b.normal, 0, sizeof b.normal);
        memset(b.silhouette, 0, sizeof b.silhouette);
        for (int i = 0; i < SIDE * SIDE; i++) {
            if (!pixels[i]) check_not_asked(&b, i, &how);
            else CHECK_BYTES(sizeof(float), &a.depth[i], &b.depth[i]);
        }
        out = all_planes(&b); /* with the silhouette there are tiles, but still no other ray */
        out.color = NULL;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        CHECK_EQUAL(20, b.stats.rays);
        CHECK_EQUAL(0, b.stats.cone_queries);
        CHECK(b.stats.silhouette_queries <= 20 * 16);
        CHECK(b.stats.normal_queries == b.stats.hits && b.stats.hits > 0 && b.stats.hits < 20);
        CHECK(b.stats.queries - b.stats.silhouette_queries - b.stats.normal_queries <= alone);
        for (int i = 0; i < SIDE * SIDE; i++) {
            if (!pixels[i]) check_not_asked(&b, i, &how);
            else CHECK(a.mask[i] == b.mask[i] && (a.silhouette[i] < 0) == (b.silhouette[i] < 0));
        }
    }
    dist_context_destroy(ctx);
}

TEST(a_window_of_pixels_is_what_the_whole_picture_shows_there)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int k = 0; k < 6; k++) {
        test_shape shape = some_shape(k % 3);
        dist_field field = shape_field(&shape, 1, 1);
        static unsigned char pixels[SIDE * SIDE];
        dist_render_desc how = plain_how();
        how.trace = k < 3 ? DIST_TRACE_GUARDED : DIST_TRACE_PAPER;
        dist_images out = all_planes(&a);
        out.color = NULL;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        for (int i = 0; i < SIDE * SIDE; i++) {
            int x = i % SIDE, y = i / SIDE;
            pixels[i] = x >= 30 && x < 57 && y >= 20 && y < 70;
        }
        how.pixels = pixels;
        out = all_planes(&b);
        out.color = NULL;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        CHECK_EQUAL(27 * 50, b.stats.rays);
        CHECK(b.stats.queries < a.stats.queries * 3 / 4);
        for (int i = 0; i < SIDE * SIDE; i++) {
            if (!pixels[i]) {
                check_not_asked(&b, i, &how);
                continue;
            }
            CHECK_EQUAL(a.mask[i], b.mask[i]);
            CHECK_NEAR((double)a.distance[i], (double)b.distance[i], k < 3 ? 4e-4 : 4e-3);
        }
        memset(pixels, 0, sizeof pixels);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        CHECK_EQUAL(0, b.stats.queries + b.stats.rays);
    }
    dist_context_destroy(ctx);
}

#ifndef DIST_NO_BACKWARD
TEST(pixels_not_asked_for_give_no_gradient)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    const float torus[5] = {0, 0, 0, 0.6f, 0.2f};
    dist_field field = dist_field_torus(torus);
    static unsigned char pixels[SIDE * SIDE];
    static float ones[SIDE * SIDE], picked[SIDE * SIDE];
    float code[2][5] = {{0}}, turn[2][3] = {{0}};
    for (int k = 0; k < 2; k++) { /* all pixels traced, some looked at; only those traced, all looked at */
        dist_render_desc how = plain_how();
        dist_gradients grads;
        dist_images d_out;
        memset(&grads, 0, sizeof grads);
        memset(&d_out, 0, sizeof d_out);
        dist_tape *tape = dist_tape_create(ctx, &camera, &how);
        for (int i = 0; i < SIDE * SIDE; i++) {
            ones[i] = 1;
            pixels[i] = i % 7 == 3;
            picked[i] = pixels[i];
        }
        how.pixels = k ? pixels : NULL;
        dist_images out = all_planes(&a);
        out.color = NULL;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, tape), ctx);
        d_out.depth = d_out.silhouette = k ? ones : picked;
        d_out.stats = &a.stats;
        grads.code = code[k];
        grads.rotation = turn[k];
        CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
        CHECK(a.stats.skipped >= SIDE * SIDE * 6 / 7 && a.stats.skipped < SIDE * SIDE);
        dist_tape_destroy(tape);
    }
    /* the hits differ within their error bounds, and grazing rays divide by little */
    for (int j = 0; j < 5; j++) CHECK_NEAR((double)code[0][j], (double)code[1][j], 5.0);
    for (int j = 0; j < 3; j++) CHECK_NEAR((double)turn[0][j], (double)turn[1][j], 5.0);
    CHECK(fabs((double)code[0][4]) > 100.0);
    dist_context_destroy(ctx);
}
#endif

/* A distance within its bounding sphere, and what one likes outside: how many times it was asked for there. */
typedef struct inner_ball {
    float center[3], outside;
    long asked_outside;
} inner_ball;

static void inner_ball_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    inner_ball *ball = (inner_ball *)user; /* one worker */
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        double d[3], length = 0;
        for (int k = 0; k < 3; k++) {
            d[k] = (double)points[3 * i + (size_t)k] - (double)ball->center[k];
            length += d[k] * d[k];
        }
        length = sqrt(length);
        ball->asked_outside += length > 1 + 1e-6;
        sdf[i] = length > 1 + 1e-6 ? ball->outside : (float)(length - 0.9);
        for (int k = 0; gradient && k < 3; k++) gradient[3 * i + (size_t)k] = (float)(d[k] / fmax(length, 1e-6));
    }
}

/* Nothing is asked outside the bounding sphere, by rays, cones, warm starts and silhouettes, and so whatever f is there
   the picture is the same: a grid has no values there, and a lookup's default is no distance. */
TEST(what_f_is_outside_the_bounding_sphere_does_not_matter)
{
    const uint32_t nan_bits = 0x7fc00000u;
    static const int sizes[4][2] = {{47, 1}, {32, 20}, {128, 96}, {1, 64}};
    static float depth[2][128 * 96], silhouette[2][128 * 96];
    static unsigned char status[2][128 * 96];
    dist_context_desc one = {0};
    one.workers = 1;
    dist_context *ctx = dist_context_create(&one);
    inner_ball ball;
    dist_field field;
    memset(&ball, 0, sizeof ball);
    ball.center[0] = 0.2f;
    ball.center[1] = -0.1f;
    ball.center[2] = 0.3f;
    memset(&field, 0, sizeof field);
    field.user = &ball;
    field.eval_fn = inner_ball_eval;
    memcpy(field.center, ball.center, sizeof field.center);
    field.radius = 1;
    for (int k = 0; k < 4 * 3 * 5; k++) {
        const int *size = sizes[k % 4];
        float far_off = k / 4 % 3 == 0 ? 2.2f : k / 4 % 3 == 1 ? 1.05f : 0.95f, eye[3];
        for (int i = 0; i < 3; i++) eye[i] = ball.center[i] + far_off * (i == 2 ? -0.8f : i == 1 ? 0.6f : 0);
        dist_camera camera = dist_camera_look_at(size[0], size[1], k % 5 ? 1.0f : 2.5f, eye, ball.center, NULL);
        dist_render_desc how;
        memset(&how, 0, sizeof how);
        how.certified = k / 12 == 1;
        how.no_cones = k / 12 == 2;
        how.warm_start = k / 12 == 3;
        size_t n = (size_t)size[0] * (size_t)size[1];
        ball.asked_outside = 0;
        for (int j = 0; j < 3; j++) {
            dist_images out;
            memset(&out, 0, sizeof out);
            out.depth = depth[j > 0];
            out.status = status[j > 0];
            if (k / 12 != 4) out.silhouette = silhouette[j > 0];
            ball.outside = j == 0 ? 0.3f : 1000.0f;
            if (j == 2) memcpy(&ball.outside, &nan_bits, sizeof nan_bits);
            dist_tape *tape = dist_tape_create(ctx, &camera, &how);
            for (int again = 0; again < 1 + how.warm_start; again++)
                CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, tape), ctx);
            dist_tape_destroy(tape);
            CHECK(memcmp(depth[0], depth[j > 0], n * sizeof(float)) == 0);
            CHECK(memcmp(status[0], status[j > 0], n) == 0);
            if (out.silhouette) CHECK(memcmp(silhouette[0], silhouette[j > 0], n * sizeof(float)) == 0);
        }
        CHECK_EQUAL(0, ball.asked_outside);
    }
    dist_context_destroy(ctx);
}

/* ---- how.max_queries -------------------------------------------------------------------------------------------- */

/* Whatever the budget: it is kept, what is called a hit is one, what is called a miss is one, and a surface is no
   farther from an unresolved ray's distance than its error. */
TEST(a_query_budget_is_kept_and_more_of_it_finds_more)
{
    enum { W = 100, H = 70 };
    const double budgets[11] = {1e-3, 0.1, 0.3, 0.6, 1, 1.5, 2, 4, 10, 100, 1000};
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(W, H);
    test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    static float expected[W * H];
    int crossing = 0;
    for (int i = 0; i < W * H; i++) {
        double o[3], d[3], t0 = 0, t1 = 0;
        shape_pixel(&camera, i % W, i / W, o, d);
        shape_crossing c;
        memset(&c, 0, sizeof c);
        if (shape_enter(o, d, 1, &t0, &t1)) c = shape_cross(&shape, o, d, t0, t1, 1, 1e-4, 1e-4);
        expected[i] = c.crosses && c.below > 2e-6                ? (float)c.t
                      : c.crosses || (t1 > t0 && c.least < 1e-4) ? -1.0f
                                                                 : 0.0f;
        crossing += c.crosses;
    }
    for (int k = 0; k < 7;
         k++) { /* guarded without and with normals and silhouette, and without helpers; the paper's */
        dist_render_desc how = plain_how();
        dist_images out = all_planes(&a);
        int finished = 0;
        double before = 1e9;
        if (k != 1) out.normal = NULL;
        if (k == 0 || k > 4) out.silhouette = NULL;
        how.no_prediction = k == 2;
        how.no_cones = k == 3;
        how.trace = k >= 4 ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        how.paper_row = k == 6 ? DIST_PAPER_PARALLEL : 0;
        if (k == 5) out.normal = a.normal, how.normal_mode = DIST_NORMAL_DIFFERENCE;
        for (int j = 0; j < 11; j++) {
            int hits = 0, resolved = 0, false_hits = 0, false_misses = 0, far = 0, broken = 0;
            double sum = 0;
            how.max_queries = (unsigned long long)(budgets[j] * W * H);
            shape.queries = 0;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
            CHECK_EQUAL(shape.queries, a.stats.queries);
            CHECK(a.stats.queries <= how.max_queries);
            for (int i = 0; i < W * H; i++) {
                int unresolved = a.status[i] == DIST_RAY_UNRESOLVED;
                double off = fabs((double)a.distance[i] - (double)expected[i]);
                hits += a.mask[i];
                resolved += !unresolved;
                broken += !test_finite((double)a.distance[i]) || !test_finite((double)a.error[i]) || a.error[i] < 0;
                if (out.silhouette)
                    broken += !test_finite((double)a.silhouette[i]) || fabs((double)a.silhouette[i]) > 2 ||
                              (a.silhouette[i] < 0) != a.mask[i];
                if (out.normal) {
                    const float *n = out.normal + 3 * i;
                    CHECK_NEAR(a.mask[i], shape_length((double)n[0], (double)n[1], (double)n[2]), 1e-5);
                }
                if (expected[i] < 0) continue; /* a touch */
                false_hits += a.mask[i] && !(expected[i] > 0);
                false_misses += !a.mask[i] && !unresolved && expected[i] > 0;
                if (expected[i] > 0) sum += off;
                if (expected[i] > 0 && (a.mask[i] || unresolved))
                    far += off > (double)a.error[i] + (k >= 4 ? 1e-4 / 0.05 : 2e-6);
            }
            CHECK_EQUAL(0, broken);
            CHECK_EQUAL(0, false_hits);
            CHECK(false_misses == 0 || (k >= 4 && false_misses * 100 < crossing)); /* the paper's own */
            CHECK(far * 20 <= crossing * (k == 4 || k == 5)); /* coarse-to-fine's hits are its parents' */
            if (!CHECK(resolved >= finished))
                printf("    case %d, budget %g: %d resolved, %d before\n", k, budgets[j], resolved, finished);
            if (test_state.verbose)
                printf(
                    "    case %d, %g a ray: %.2f used, %d of %d hit, %d resolved, %d false, %d off, mean error %.5f\n",
                    k, budgets[j], (double)a.stats.queries / (W * H), hits, crossing, resolved,
                    false_hits + false_misses, far, sum / crossing);
            CHECK(sum <= 1.001 * before + 1e-3 * crossing);
            finished = resolved;
            before = sum;
            if (j == 10 && k < 4) CHECK(hits * 100 >= crossing * 99 && a.stats.unresolved * 100 <= (unsigned)crossing);
        }
    }
    dist_context_destroy(ctx);
}

TEST(a_query_budget_gives_the_same_bits_for_every_number_of_workers)
{
    static planes first;
    static unsigned char pixels[90 * 75];
    for (int i = 0; i < 90 * 75; i++) pixels[i] = i % 7 == 0;
    for (int k = 0; k < 21; k++) {
        test_scheduler scheduler;
        dist_context_desc desc = test_context_desc();
        test_shape shape = some_shape(k % 3);
        dist_field field = shape_field(&shape, 1, 1);
        dist_camera camera = shape_camera(90, 75);
        dist_render_desc how = plain_how();
        how.trace = k % 6 >= 3 ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        how.max_queries = k < 6 ? 700 : k < 12 ? 7000 : k < 18 ? 20000 : 2000;
        if (k >= 18) how.pixels = pixels;
        for (int workers = 1; workers <= 3; workers++) {
            scheduler.workers = workers;
            scheduler.calls = k;
            desc.workers = workers;
            if (workers > 1) desc.scheduler = test_scheduler_hook(&scheduler);
            dist_context *ctx = dist_context_create(&desc);
            dist_images out = all_planes(workers == 1 ? &first : &b);
            if (k >= 18) out.silhouette = NULL;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
            if (workers > 1) CHECK_BYTES(offsetof(planes, stats), &first, &b);
            if (workers > 1) CHECK_BYTES(sizeof(dist_stats), &first.stats, &b.stats);
            CHECK(out.stats->queries <= how.max_queries && out.stats->queries * 2 > how.max_queries * (k < 6));
            dist_context_destroy(ctx);
        }
    }
}

/* One picture and its gradients, with a tape that has seen `before` pictures without a budget. */
typedef struct budgeted {
    planes picture;
    float code[64], camera[6];
} budgeted;

static void budget_render(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                          const dist_render_desc *how, int which, int before, int after, budgeted *x)
{
    static planes other;
    static float pull[3 * PIXELS];
    dist_images out = all_planes(&x->picture), d_out;
    dist_gradients grads;
    dist_tape *tape = dist_tape_create(ctx, camera, how);
    dist_render_desc plain = *how;
    memset(x, 0, sizeof *x);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    plain.max_queries = 0;
    if (!(which & 1)) out.silhouette = NULL;
    if (!(which & 2)) out.normal = NULL;
    for (int i = 0; i < 3 * PIXELS; i++) pull[i] = i % 3 ? 0.25f : -1.0f;
    for (int i = 0; i < before; i++) {
        dist_images first = all_planes(&other);
        CHECK_STATUS(DIST_OK, dist_render(ctx, field, camera, &plain, &first, tape), ctx);
    }
    CHECK_STATUS(DIST_OK, dist_render(ctx, field, camera, how, &out, tape), ctx);
    for (int i = 0; i < after; i++) CHECK_STATUS(DIST_OK, dist_render(ctx, field, camera, &plain, &out, tape), ctx);
    d_out.depth = pull;
    if (out.silhouette) d_out.silhouette = pull;
    if (out.normal) d_out.normal = pull;
    grads.code = x->code;
    grads.rotation = x->camera;
    grads.translation = x->camera + 3;
    CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
    dist_tape_destroy(tape);
}

static int finite_all(size_t n, const float *x)
{
    for (size_t i = 0; i < n; i++)
        if (!test_finite((double)x[i])) return 0;
    return 1;
}

/* Budgets of 1, 2, 3, one less than is spent without, exactly that, and huge, for whatever there is to ask: never
   above it, nothing but numbers, truthful statuses and bounds, a gradient, the same bits for 1 and 3 workers, and
   afterwards a picture as if nothing had been. */
TEST(extreme_budgets_give_the_best_so_far_and_leave_no_trace)
{
    enum { W = 72, H = 56, CASES = 11 };
    static budgeted full, some, three, again;
    static unsigned char pixels[W * H];
    const float ball[3][4] = {{0, 0, 0, 0.5f}, {0.9f, 0, 0, 0.3f}, {-0.8f, 0.3f, 0.2f, 0.25f}};
    const float torus[5] = {0, 0, 0, 0.6f, 0.2f};
    dist_camera camera = shape_camera(W, H);
    for (int i = 0; i < W * H; i++) pixels[i] = i % 7 == 0;
    for (int k = 0; k < CASES; k++) {
        dist_render_desc how = plain_how();
        int which = k == 1 ? 1 : k == 2 || k == 3 ? 2 : k == 4 || k > 8 ? 3 : 0, before = k == 9 ? 2 : k == 10;
        how.normal_mode = k == 3 ? DIST_NORMAL_DIFFERENCE : DIST_NORMAL_ANALYTIC;
        how.certified = k == 5;
        if (k == 6 || k == 7) how.trace = DIST_TRACE_PAPER;
        how.paper_row = k == 7 ? DIST_PAPER_DYNAMIC : DIST_PAPER_COARSE_TO_FINE;
        if (k == 8) how.pixels = pixels;
        how.warm_start = before > 0;
        for (int j = 0; j < 6; j++) {
            for (int workers = 1; workers <= 3; workers += 2) {
                test_scheduler scheduler;
                dist_context_desc desc = test_context_desc();
                dist_field parts[3], field = dist_field_torus(torus);
                dist_instance instances[3];
                dist_scene *scene = NULL;
                scheduler.workers = desc.workers = workers;
                scheduler.calls = j;
                if (workers > 1) desc.scheduler = test_scheduler_hook(&scheduler);
                dist_context *ctx = dist_context_create(&desc);
                memset(instances, 0, sizeof instances);
                for (int i = 0; i < 3; i++) {
                    parts[i] = dist_field_sphere(ball[i]);
                    instances[i].field = &parts[i];
                }
                if (k == 4 || k == 10) {
                    scene = dist_scene_create(ctx, 3, instances);
                    field = dist_scene_field(scene);
                }
                how.max_queries = 0;
                if (workers == 1) budget_render(ctx, &field, &camera, &how, which, before, 0, &full);
                unsigned long long need = full.picture.stats.queries;
                const unsigned long long budgets[6] = {1, 2, 3, need - 1, need, ~0ull};
                how.max_queries = budgets[j];
                budgeted *x = workers == 1 ? &some : &three;
                budget_render(ctx, &field, &camera, &how, which, before, 0, x);
                const planes *p = &x->picture;
                unsigned long long hits = 0, unresolved = 0;
                int wrong = 0;
                CHECK(p->stats.queries <= budgets[j]);
                CHECK(finite_all(W * H, p->depth) && finite_all(W * H, p->distance) && finite_all(W * H, p->error));
                CHECK(finite_all(3 * W * H, p->normal) && finite_all(W * H, p->silhouette));
                CHECK(finite_all(64, x->code) && finite_all(6, x->camera) && test_finite((double)p->stats.error));
                for (int i = 0; i < W * H; i++) {
                    double off = fabs((double)p->distance[i] - (double)full.picture.distance[i]);
                    hits += p->mask[i];
                    unresolved += p->status[i] == DIST_RAY_UNRESOLVED;
                    if (how.trace == DIST_TRACE_PAPER) continue;
                    wrong += p->mask[i] && full.picture.status[i] == DIST_RAY_MISS;
                    if (!full.picture.mask[i]) continue;
                    wrong += !p->mask[i] && p->status[i] != DIST_RAY_UNRESOLVED;
                    wrong += off > (double)p->error[i] + (double)full.picture.error[i] + 2e-6;
                }
                CHECK_EQUAL(hits, p->stats.hits);
                CHECK_EQUAL(unresolved, p->stats.unresolved);
                if (!CHECK(wrong * 500 <= (int)full.picture.stats.hits)) /* two traces of what only touches */
                    printf("    case %d, budget %d, %d workers: %d wrong of %d\n", k, j, workers, wrong,
                           (int)full.picture.stats.hits);
                if (j == 5) CHECK_BYTES(offsetof(planes, stats), &full.picture, p);
                if (workers == 3) CHECK_BYTES(sizeof some, &some, &three);
                if (j == 1 && before == 0) { /* and once more without a budget, on the same tape */
                    budget_render(ctx, &field, &camera, &how, which, 0, 1, &again);
                    CHECK_BYTES(sizeof full, &full, &again);
                }
                dist_scene_destroy(scene);
                dist_context_destroy(ctx);
            }
        }
    }
}

TEST(a_query_budget_of_free_rays_is_kept)
{
    enum { RAYS = 2500 };
    static float o[3 * RAYS], d[3 * RAYS];
    static dist_hit hits[RAYS];
    dist_context *ctx = shape_context();
    test_random r = test_random_seed(11);
    test_shape shape = some_shape(1);
    dist_field field = shape_field(&shape, 1, 1);
    unsigned long long resolved = 0;
    for (size_t i = 0; i < RAYS; i++) {
        test_random_direction(&r, o + 3 * i);
        for (size_t k = 0; k < 3; k++) {
            o[3 * i + k] *= 1.5f;
            d[3 * i + k] = test_random_float(&r, -0.5f, 0.5f) - o[3 * i + k];
        }
    }
    for (int j = 0; j < 6; j++) {
        const unsigned long long budgets[6] = {1, 2500, 5000, 10000, 20000, 1000000};
        dist_render_desc how = plain_how();
        dist_stats stats;
        how.max_queries = budgets[j];
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, o, d, &how, hits, &stats), ctx);
        CHECK(stats.queries <= budgets[j]);
        CHECK(RAYS - stats.unresolved >= resolved);
        resolved = RAYS - stats.unresolved;
        for (int i = 0; i < RAYS; i++) {
            if (hits[i].status != DIST_RAY_UNRESOLVED) continue;
            CHECK(hits[i].error > 0 && hits[i].error < 2.001f && hits[i].distance >= 0);
        }
    }
    CHECK(resolved * 1000 > RAYS * 995);
    dist_context_destroy(ctx);
}

/* What goes by the field's radius is not fixed before the field is known. */
TEST(a_resolved_desc_gives_the_same_picture)
{
    enum { EDGE = 24 };
    static float normal[2][3 * EDGE * EDGE];
    static float depth[2][EDGE * EDGE];
    float radii[5] = {0, 0, 0, 12, 5}, eye[3] = {0, 30, 40}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_context *ctx = test_context();
    dist_field field = dist_field_torus(radii);
    dist_camera camera = dist_camera_look_at(EDGE, EDGE, 0.7f, eye, at, up);
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.normal_mode = DIST_NORMAL_DIFFERENCE;
    for (int k = 0; k < 2; k++, how = dist_render_desc_resolve(&how)) {
        dist_images out;
        memset(&out, 0, sizeof out);
        out.depth = depth[k];
        out.normal = normal[k];
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
    }
    CHECK_BYTES(sizeof depth[0], depth[0], depth[1]);
    CHECK_BYTES(sizeof normal[0], normal[0], normal[1]);
    dist_context_destroy(ctx);
}

/* The less of two balls, center and radius each. */
static void two_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const float *balls = (const float *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        sdf[i] = 3e38f;
        for (int j = 0; j < 2; j++) {
            float q[3], length = 1e-12f, f;
            for (int k = 0; k < 3; k++) {
                q[k] = points[3 * i + (size_t)k] - balls[4 * j + k];
                length += q[k] * q[k];
            }
            length = sqrtf(length);
            f = length - balls[4 * j + 3];
            if (f >= sdf[i]) continue;
            sdf[i] = f;
            for (int k = 0; gradient && k < 3; k++) gradient[3 * i + (size_t)k] = q[k] / length;
        }
    }
}

/* A ray that misses both of two balls one of which a pixel beside it shows: nearly always the nearest of the two is
   what the silhouette tells of; at a tile's border, where what the pixel beside it hit is not known, it may be the
   other. */
TEST(the_silhouette_beside_an_outline_is_that_of_the_part_beside_it)
{
    enum { PIC = 64, COUNT = PIC * PIC };
    static float silhouette[COUNT];
    static unsigned char hit[COUNT];
    dist_context *ctx = shape_context();
    test_random random = test_random_seed(77);
    float eye[3] = {0, 0, -2.5f}, balls[8];
    dist_camera camera = dist_camera_look_at(PIC, PIC, 0.7f, eye, NULL, NULL);
    dist_field field;
    dist_images out;
    memset(&field, 0, sizeof field);
    memset(&out, 0, sizeof out);
    out.silhouette = silhouette;
    out.mask = hit;
    field.user = balls;
    field.eval_fn = two_eval;
    field.radius = field.lipschitz = 1;
    field.detail = 0.1f;
    int beside = 0, off = 0, pictures = test_quick() ? 300 : 1500;
    for (int picture = 0; picture < pictures; picture++) {
        for (int j = 0; j < 8; j++)
            balls[j] = j % 4 < 3 ? test_random_float(&random, -0.45f, 0.45f) : test_random_float(&random, 0.1f, 0.4f);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < COUNT; i++) {
            int x = i % PIC, y = i / PIC, shown = 0;
            float o[3], d[3];
            double least = 1e9;
            for (int at = 0; at < 9 && !hit[i]; at++) {
                int u = x + at % 3 - 1, v = y + at / 3 - 1;
                shown += u >= 0 && v >= 0 && u < PIC && v < PIC && hit[v * PIC + u];
            }
            if (!shown) continue;
            dist_camera_ray(&camera, (float)x, (float)y, o, d);
            for (int j = 0; j < 2; j++) {
                double q[3], along = 0, square = 0;
                for (int k = 0; k < 3; k++) {
                    q[k] = (double)o[k] - (double)balls[4 * j + k];
                    along += q[k] * (double)d[k];
                }
                for (int k = 0; k < 3; k++) square += (q[k] - along * (double)d[k]) * (q[k] - along * (double)d[k]);
                least = fmin(least, sqrt(square) - (double)balls[4 * j + 3]);
            }
            if (least < 1e-3 || least > 0.035) continue;
            beside++;
            off += fabs((double)silhouette[i] - least) > 0.2 * least + 1e-3;
        }
    }
    if (test_state.verbose) printf("    %d of %d\n", off, beside);
    CHECK(beside > 100 * pictures && 700 * off <= beside);
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(planes_mean_what_the_interface_says);
    RUN(planes_left_out_are_not_touched_and_cost_nothing);
    RUN(color_is_the_fields_at_the_hit);
    RUN(normals_are_the_closed_form_by_either_way_in_either_space);
    RUN(normals_of_cheap_fields_come_with_the_last_samples);
    RUN(a_surface_without_slope_has_normal_zero_or_unit_and_nothing_is_nan);
    RUN(silhouette_near_the_outline_is_the_smallest_f_on_98_of_100);
    RUN(silhouette_of_misses_is_the_smallest_f_on_92_of_100);
    RUN(silhouette_of_a_box_is_the_smallest_f_along_its_edges);
    RUN(silhouette_beside_rods_is_that_of_the_nearest_rod);
    RUN(silhouette_of_a_clamped_field_is_seen_from_the_plateau);
    RUN(silhouette_off_the_sphere_is_the_distance_to_it);
    RUN(a_smaller_picture_asks_for_less);
    RUN(silhouette_is_continuous_and_the_mask_changes_by_single_pixels);
    RUN(scale_of_the_world_changes_nothing);
    RUN(far_cameras_see_what_double_sees);
    RUN(focal_lengths_from_a_thousandth_to_a_million_are_finite);
    RUN(pictures_of_any_shape_agree_with_single_pixels);
    RUN(a_picture_and_its_crop_agree);
    RUN(huge_tapes_are_refused_or_had_without_overflow);
    RUN(workers_and_order_of_tasks_change_no_bit);
    RUN(counts_add_up);
    RUN(operations_done_are_no_more_than_a_dense_net_would_do);
    RUN(a_tape_is_for_its_size_and_trace);
    RUN(a_field_without_adjoint_renders_but_its_gradient_is_refused);
    RUN(render_refuses_null_and_garbage_with_a_sentence);
    RUN(inside_modes_are_what_the_desc_says);
    RUN(nan_from_the_field_spoils_only_its_pixels);
    RUN(dead_fields_are_all_miss_all_inside_or_plateau);
    RUN(twenty_points_cost_no_more_than_their_twenty_rays);
    RUN(a_window_of_pixels_is_what_the_whole_picture_shows_there);
#ifndef DIST_NO_BACKWARD
    RUN(pixels_not_asked_for_give_no_gradient);
#endif
    RUN(what_f_is_outside_the_bounding_sphere_does_not_matter);
    RUN(a_query_budget_is_kept_and_more_of_it_finds_more);
    RUN(a_query_budget_gives_the_same_bits_for_every_number_of_workers);
    RUN(extreme_budgets_give_the_best_so_far_and_leave_no_trace);
    RUN(a_query_budget_of_free_rays_is_kept);
    RUN(a_resolved_desc_gives_the_same_picture);
    RUN(the_silhouette_beside_an_outline_is_that_of_the_part_beside_it);
    return test_report();
}
