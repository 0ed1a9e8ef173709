/* SPDX-License-Identifier: MIT-0
   Both tracers against fields worked out in double: what is hit, how far off, what is said of it, and at what price.
   Numbers in comments are rows of the table of hard cases. */
#include "shapes.h"

enum { SIDE = 128, PIXELS = SIDE * SIDE, WIDE = 256 };

typedef struct picture {
    float distance[WIDE * WIDE], error[WIDE * WIDE];
    unsigned char mask[WIDE * WIDE], status[WIDE * WIDE];
    dist_stats stats;
} picture;

static picture picture_a, picture_b;

static dist_status picture_render(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                                  const dist_render_desc *how, picture *p)
{
    dist_images out;
    memset(&out, 0, sizeof out);
    out.distance = p->distance;
    out.error = p->error;
    out.mask = p->mask;
    out.status = p->status;
    out.stats = &p->stats;
    return dist_render(ctx, field, camera, how, &out, NULL);
}

static dist_render_desc plain_how(void)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    return how;
}

static float test_nan(void)
{
    uint32_t bits = 0x7fc00000u;
    float nan;
    memcpy(&nan, &bits, sizeof nan);
    return nan;
}

/* A picture against the crossings in double. */
typedef struct verdict {
    int crossing; /* pixels whose ray certainly crosses */
    int missed;   /* of them, those neither hit nor reported as unresolved */
    int spent;    /* of them, those reported as unresolved */
    int phantom;  /* hits of rays that keep clear of the surface */
    int outline;  /* rays that barely touch: anything goes */
    int judged;   /* hits whose distance is judged */
    int broken;   /* of them, those farther off than their error bound and float's rounding */
    double worst; /* distance off */
    int unresolved;
} verdict;

static verdict judge(const test_shape *shape, const dist_camera *camera, double radius, double lipschitz, double step,
                     const picture *p)
{
    verdict v;
    memset(&v, 0, sizeof v);
    double slope = shape->slope > 0 ? shape->slope : 1, epsilon = 5e-5 * radius / slope, shallow = 2e-6 * radius;
    for (int i = 0; i < camera->width * camera->height; i++) {
        double o[3], d[3], t0, t1;
        shape_pixel(camera, i % camera->width, i / camera->width, o, d);
        if (!shape_enter(o, d, radius, &t0, &t1)) {
            v.phantom += p->mask[i];
            continue;
        }
        shape_crossing c = shape_cross(shape, o, d, t0, t1, lipschitz, step, epsilon);
        v.unresolved += p->status[i] == DIST_RAY_UNRESOLVED;
        if (c.crosses && c.below > shallow) {
            v.crossing++;
            v.missed += !p->mask[i] && p->status[i] != DIST_RAY_UNRESOLVED;
            v.spent += p->status[i] == DIST_RAY_UNRESOLVED;
        } else if (c.crosses || c.least < 1.5 * epsilon) {
            v.outline++;
            continue;
        } else {
            v.phantom += p->mask[i];
        }
        if (!p->mask[i] || !c.crosses || c.touched) continue;
        /* f is known to half a float's spacing, so t is to that over the slope along the ray. */
        double off = fabs((double)p->distance[i] - c.t),
               rounding = 2.5e-7 * c.t + 3e-7 * radius + 6e-8 / fmax(fabs(c.slope), 1e-3);
        v.judged++;
        v.worst = fmax(v.worst, off);
        v.broken += off > (double)p->error[i] + rounding;
    }
    return v;
}

typedef struct shape_case {
    const char *name;
    test_shape shape;
    double radius, lipschitz; /* of the field */
    double exact;             /* Lipschitz bound of the exact shape */
} shape_case;

enum { CASES = 9 };

static void shape_cases(shape_case c[CASES])
{
    memset(c, 0, CASES * sizeof *c);
    for (int i = 0; i < CASES; i++) {
        c[i].radius = c[i].lipschitz = c[i].exact = 1;
    }
    c[0].name = "sphere";
    c[0].shape = shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0);
    c[1].name = "torus";
    c[1].shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    c[2].name = "box";
    c[2].shape = shape_make(SHAPE_BOX, 0.4, 0.5, 0.3, 0);
    c[3] = c[1];
    c[3].name = "torus of slope 0.5";
    c[3].shape.slope = 0.5;
    c[4] = c[1];
    c[4].name = "torus of slope 2";
    c[4].shape.slope = 2;
    c[4].lipschitz = 2;
    c[5] = c[1];
    c[5].name = "torus clamped at 0.1";
    c[5].shape.clamp = 0.1;
    c[6] = c[0];
    c[6].name = "bumps";
    c[6].shape = shape_make(SHAPE_BUMPY, 0.7, 0.05, 12, 0);
    c[6].exact = c[6].lipschitz = 1.6;
    c[7] = c[2];
    c[7].name = "box clamped at 0.1";
    c[7].shape.clamp = 0.1;
    c[8].name = "shells";
    c[8].shape = shape_make(SHAPE_SHELLS, 0.02, 0, 0, 0);
}

static int side(void)
{
    return test_quick() ? 48 : SIDE;
}

/* Pixels of large pictures, and a quarter of them in slow surroundings. */
static int bound_side(void)
{
    return test_quick() ? SIDE : WIDE;
}

/* A spent budget is reported, and rare: rays that graze a field of half the slope. */
TEST(every_crossing_is_hit_and_999_of_1000_within_the_error_bound)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(side(), side());
    shape_case cases[CASES];
    shape_cases(cases);
    for (int k = 0; k < CASES; k++) {
        dist_field field = shape_field(&cases[k].shape, cases[k].radius, cases[k].lipschitz);
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, NULL, &picture_a), ctx);
        verdict v = judge(&cases[k].shape, &camera, cases[k].radius, cases[k].exact, 1e-5, &picture_a);
        int good = CHECK_EQUAL(0, v.missed) & CHECK_EQUAL(0, v.phantom) & CHECK(v.broken * 1000 <= v.judged) &
                   CHECK(v.spent * 500 <= v.crossing + 1500) & CHECK(v.judged > v.crossing * 9 / 10) &
                   CHECK(v.outline < v.crossing / 50 + 10);
        if (!good || test_state.verbose)
            printf("    %s: crossing %d, missed %d, phantom %d, outline %d, judged %d, off by more than the bound %d, "
                   "worst %.1e, "
                   "unresolved %d, queries %llu\n",
                   cases[k].name, v.crossing, v.missed, v.phantom, v.outline, v.judged, v.broken, v.worst, v.spent,
                   picture_a.stats.queries);
    }
    dist_context_destroy(ctx);
}

/* 17 */
TEST(no_plate_however_thin_is_missed)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(side(), side());
    const double thin[5] = {1e-1, 1e-2, 1e-3, 1e-4, 1e-5};
    for (int k = 0; k < 5; k++) {
        for (int flat = 0; flat < 2; flat++) {
            test_shape shape = shape_make(SHAPE_BOX, flat ? 0.6 : 0.5 * thin[k], 0.5, flat ? 0.5 * thin[k] : 0.6, 0);
            dist_field field = shape_field(&shape, 1, 1);
            CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, NULL, &picture_a), ctx);
            verdict v = judge(&shape, &camera, 1, 1, fmin(1e-5, 0.1 * thin[k]), &picture_a);
            int good = CHECK_EQUAL(0, v.missed) & CHECK_EQUAL(0, v.spent) & CHECK_EQUAL(0, v.phantom) &
                       CHECK(v.broken * 1000 <= v.judged);
            if (!good || test_state.verbose)
                printf(
                    "    %g thick: crossing %d, missed %d, phantom %d, outline %d, judged %d, broken %d, worst %.1e\n",
                    thin[k], v.crossing, v.missed, v.phantom, v.outline, v.judged, v.broken, v.worst);
        }
    }
    dist_context_destroy(ctx);
}

/* 17, where pixels are so small that most hits are predicted, and spheres that other rays know to be empty lead up to
   the plate. */
TEST(no_thin_plate_is_missed_by_large_pictures)
{
    dist_context *ctx = shape_context();
    const double thin[3] = {1e-3, 3e-5, 1e-5};
    const float at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    int size = bound_side(), crossing = 0, missed = 0;
    for (int k = 0; k < 3 * 2 * 3 * 2; k++) {
        int flat = k / 3 % 2, view = k / 6 % 3;
        double d = thin[k % 3];
        test_shape shape = shape_make(SHAPE_BOX, flat ? 0.6 : 0.5 * d, 0.5, flat ? 0.5 * d : 0.6, 0);
        dist_field field = shape_field(&shape, 1, 1);
        float turn = 0.6f + 1.3f * (float)view, rise = 0.3f - 0.25f * (float)view;
        float eye[3] = {2.2f * cosf(rise) * sinf(turn), 2.2f * sinf(rise), 2.2f * cosf(rise) * cosf(turn)};
        dist_camera camera = dist_camera_look_at(size, size, size < WIDE ? 0.5f : 0.95f, eye, at, up);
        dist_render_desc how = plain_how();
        how.certified = k >= 18;
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        verdict v = judge(&shape, &camera, 1, 1, fmin(1e-5, 0.1 * d), &picture_a);
        crossing += how.certified ? 0 : v.crossing;
        missed += how.certified ? 0 : v.missed;
        int good = CHECK_EQUAL(0, v.missed) & CHECK_EQUAL(0, v.spent) & CHECK_EQUAL(0, v.phantom) &
                   CHECK(v.broken * 1000 <= v.judged) & CHECK(v.crossing > 0);
        if (!good || test_state.verbose)
            printf("    %g thick, flat %d, view %d, certified %d: crossing %d, missed %d, phantom %d, outline %d, "
                   "judged %d, broken %d, worst %.1e, queries %llu\n",
                   d, flat, view, how.certified, v.crossing, v.missed, v.phantom, v.outline, v.judged, v.broken,
                   v.worst, picture_a.stats.queries);
        if (how.certified) continue;
        how.no_prediction = 1;
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_b), ctx);
        CHECK(3 * picture_a.stats.queries < 2 * picture_b.stats.queries); /* it is a picture that is predicted */
    }
    if (test_state.verbose) printf("    of %d pixels of plates %d are missed\n", crossing, missed);
    dist_context_destroy(ctx);
}

/* A face that rays meet at slopes of .06 to .12 is foretold by neighbors like any other. */
TEST(faces_at_a_grazing_angle_take_one_query_a_pixel_or_so)
{
    dist_context *ctx = shape_context();
    const float eye[3] = {0.3f, 0.24f, 2.2f}, at[3] = {0, 0.05f, 0}, up[3] = {0, 1, 0};
    test_shape shape = shape_make(SHAPE_BOX, 0.6, 0.05, 0.6, 0);
    dist_field field = shape_field(&shape, 1, 1);
    dist_camera camera = dist_camera_look_at(WIDE, WIDE, 0.62f, eye, at, up);
    CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, NULL, &picture_a), ctx);
    verdict v = judge(&shape, &camera, 1, 1, 1e-5, &picture_a);
    const dist_stats *s = &picture_a.stats;
    CHECK_EQUAL(0, v.missed);
    CHECK_EQUAL(0, v.spent);
    CHECK_EQUAL(0, v.phantom);
    CHECK(v.broken * 1000 <= v.judged && v.crossing > WIDE * WIDE / 20);
    int good = CHECK(10 * (s->march_queries + s->refine_queries) < 13 * s->hits);
    if (!good || test_state.verbose)
        printf("    crossing %d, broken %d of %d, worst %.1e; %llu hits, %llu cone, %llu march, %llu refine queries\n",
               v.crossing, v.broken, v.judged, v.worst, s->hits, s->cone_queries, s->march_queries, s->refine_queries);
    dist_context_destroy(ctx);
}

TEST(no_plate_is_missed_silently_at_any_angle)
{
    dist_context *ctx = shape_context();
    const double thin[5] = {1e-2, 1e-3, 1e-4, 3e-5, 1e-5};
    const int degrees[11] = {90, 60, 30, 20, 17, 14, 10, 7, 4, 2, 1};
    for (int a = 0; a < 11; a++) {
        for (int k = 0; k < 5; k++) {
            test_random r = test_random_seed(4);
            test_shape plate = shape_make(SHAPE_PAIR, thin[k], 10, 0, 0);
            dist_field field = shape_field(&plate, 1, 1);
            float o[3 * 200], d[3 * 200];
            dist_hit hits[200];
            double angle = degrees[a] * 3.14159265358979323846 / 180;
            int missed = 0, spent = 0;
            for (size_t j = 0; j < 200; j++) {
                double turn = test_random_double(&r, 0, 6.28), away = test_random_double(&r, 1, 2);
                d[3 * j] = (float)(cos(angle) * cos(turn));
                d[3 * j + 1] = (float)(cos(angle) * sin(turn));
                d[3 * j + 2] = (float)-sin(angle);
                for (size_t i = 0; i < 3; i++)
                    o[3 * j + i] =
                        (float)((i < 2 ? test_random_double(&r, -0.3, 0.3) : 0) - away * (double)d[3 * j + i]);
            }
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 200, o, d, NULL, hits, NULL), ctx);
            for (int j = 0; j < 200; j++) {
                missed += hits[j].status != DIST_RAY_HIT && hits[j].status != DIST_RAY_UNRESOLVED;
                spent += hits[j].status == DIST_RAY_UNRESOLVED;
            }
            if (!CHECK_EQUAL(0, missed) || (test_state.verbose && spent))
                printf("    %g thick at %d degrees: %d of 200 missed, %d unresolved\n", thin[k], degrees[a], missed,
                       spent);
            if (degrees[a] >= 4) CHECK_EQUAL(0, spent);
        }
    }
    dist_context_destroy(ctx);
}

TEST(no_rod_thinner_than_a_pixel_is_missed)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(side(), side());
    const double radius[3] = {5e-3, 1e-3, 1e-4}; /* a pixel is 0.017 wide there */
    for (int k = 0; k < 3; k++) {
        test_shape shape = shape_make(SHAPE_RODS, radius[k], 0, 0, 0);
        dist_field field = shape_field(&shape, 1, 1);
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, NULL, &picture_a), ctx);
        verdict v = judge(&shape, &camera, 1, 1, 1e-5, &picture_a);
        int good = CHECK_EQUAL(0, v.missed) & CHECK_EQUAL(0, v.spent) & CHECK_EQUAL(0, v.phantom) &
                   CHECK(v.crossing > 0 || side() < SIDE);
        if (!good || test_state.verbose)
            printf("    %g thin: crossing %d, missed %d, phantom %d, outline %d, queries %llu\n", radius[k], v.crossing,
                   v.missed, v.phantom, v.outline, picture_a.stats.queries);
    }
    dist_context_destroy(ctx);
}

/* Where pixels are smaller most hits are predicted, and rays skip what others know to be empty; where they come from
   that they must not creep along by more than the rod is thick. */
TEST(one_pixel_in_5000_of_a_rod_is_missed_by_large_pictures_and_none_certified)
{
    dist_context *ctx = shape_context();
    const float up[3] = {0, 1, 0}, at[3] = {0, 0, 0};
    test_shape shape = shape_make(SHAPE_RODS, 1e-3, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    test_random r = test_random_seed(17);
    int crossing = 0, missed[2] = {0, 0}, phantom[2] = {0, 0};
    for (int k = 0; k < (test_quick() ? 4 : 8); k++) {
        float eye[3];
        test_random_direction(&r, eye);
        for (int i = 0; i < 3; i++) eye[i] *= 2.4f;
        dist_camera camera = dist_camera_look_at(bound_side(), bound_side(), test_quick() ? 0.25f : 0.5f, eye, at, up);
        for (int certified = 0; certified < 2; certified++) {
            dist_render_desc how = plain_how();
            how.certified = certified;
            CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
            verdict v = judge(&shape, &camera, 1, 1, 1e-5, &picture_a);
            CHECK_EQUAL(0, v.spent);
            crossing += certified ? 0 : v.crossing;
            missed[certified] += v.missed;
            phantom[certified] += v.phantom; /* beside a rod by more than 1.5 epsilon, hundredths of a pixel */
        }
    }
    if (test_state.verbose)
        printf("    of %d pixels of rods %d and, certified, %d are missed; %d and %d are seen beside them\n", crossing,
               missed[0], missed[1], phantom[0], phantom[1]);
    CHECK(crossing > 500);
    CHECK(missed[0] * 5000 < crossing + 5000); /* rounded up */
    CHECK(phantom[0] * 5000 < crossing + 5000);
    CHECK_EQUAL(0, missed[1]);
    CHECK_EQUAL(0, phantom[1]);
    dist_context_destroy(ctx);
}

/* how.certified takes no step on trust: what the bounds on slopes allow is all found, none missed. */
TEST(certified_rays_miss_nothing)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(side(), side());
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.certified = 1;
    test_shape shapes[3];
    shapes[0] = shape_make(SHAPE_RODS, 2e-3, 0, 0, 0);
    shapes[1] = shape_make(SHAPE_BOX, 0.6, 0.5, 5e-4, 0);
    shapes[2] = shape_make(SHAPE_BOX, 0.05, 0.04, 0.06, 0);
    for (int k = 0; k < 3; k++) {
        dist_field field = shape_field(&shapes[k], 1, 1);
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        verdict v = judge(&shapes[k], &camera, 1, 1, 1e-5, &picture_a);
        CHECK_EQUAL(0, v.missed);
        CHECK_EQUAL(0, v.phantom);
        CHECK(v.crossing > 0);
    }
    dist_context_destroy(ctx);
}

/* A sphere that the z axis passes at *user, and one behind it that it meets at .3. */
static void passed_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const float x0 = -0.2f - *(const float *)user;
    (void)worker;
    (void)gradient;
    for (size_t i = 0; i < n; i++) {
        float x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
        float f = sqrtf((x - x0) * (x - x0) + y * y + z * z) - 0.2f;
        float g = sqrtf(x * x + y * y + (z - 0.6f) * (z - 0.6f)) - 0.3f;
        sdf[i] = f < g ? f : g;
    }
}

/* Certified, the steps are spent while f rises again: that is no plateau. (Below 8e-7 they are before it has risen by
   more than a rounding.) */
TEST(a_certified_ray_along_which_f_rises_is_on_no_plateau)
{
    dist_context *ctx = shape_context();
    for (int k = 0; k < 24; k++) {
        float least = 8e-7f + 5e-8f * (float)k, origin[3] = {0, 0, -2}, direction[3] = {0, 0, 1};
        dist_field field;
        dist_render_desc how;
        dist_hit hit;
        memset(&field, 0, sizeof field);
        memset(&how, 0, sizeof how);
        field.user = &least;
        field.eval_fn = passed_eval;
        field.radius = 1;
        how.certified = 1;
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, origin, direction, &how, &hit, NULL), ctx);
        if (test_state.verbose) printf("    %.2e: status %d at %g\n", (double)least, hit.status, (double)hit.distance);
        CHECK(hit.status == DIST_RAY_UNRESOLVED || hit.status == DIST_RAY_HIT);
    }
    dist_context_destroy(ctx);
}

/* A sheet about the plane y = 0 in front of a solid below it. */
typedef struct test_sheet {
    float half, gap;
} test_sheet;

static void sheet_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const test_sheet *sheet = (const test_sheet *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        float y = points[3 * i + 1], near = fabsf(y) - sheet->half, far = y + sheet->gap;
        sdf[i] = near < far ? near : far;
        if (!gradient) continue;
        gradient[3 * i] = gradient[3 * i + 2] = 0;
        gradient[3 * i + 1] = near < far && y < 0 ? -1.0f : 1.0f;
    }
}

/* Hits behind the sheet, among those from above. */
static int sheet_passed(dist_context *ctx, const test_sheet *sheet, const dist_render_desc *how)
{
    enum { RAYS = 1000 };
    static float o[3 * RAYS], d[3 * RAYS];
    static dist_hit hits[RAYS];
    dist_field field;
    memset(&field, 0, sizeof field);
    test_sheet copy = *sheet;
    field.user = &copy;
    field.eval_fn = sheet_eval;
    field.radius = field.lipschitz = 1;
    test_random r = test_random_seed(11);
    for (int i = 0; i < RAYS; i++) { /* at 8 to 90 degrees, toward points in the middle of the sheet */
        float angle = test_random_float(&r, 0.14f, 1.57f), turn = test_random_float(&r, 0, 6.28f);
        float to[3] = {cosf(angle) * cosf(turn), -sinf(angle), cosf(angle) * sinf(turn)};
        for (int k = 0; k < 3; k++) {
            d[3 * i + k] = to[k];
            o[3 * i + k] = (k == 1 ? 0 : test_random_float(&r, -0.2f, 0.2f)) - 2 * to[k];
        }
    }
    const float middle[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    int passed = 0;
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, o, d, how, hits, NULL), ctx);
    for (int i = 0; i < RAYS; i++) {
        CHECK_EQUAL(DIST_RAY_HIT, hits[i].status);
        passed += o[3 * i + 1] + hits[i].distance * d[3 * i + 1] < -0.5f * sheet->gap;
    }
    dist_camera camera = dist_camera_look_at(SIDE, SIDE, 0.5f, o, middle, up);
    CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, how, &picture_a), ctx);
    for (int i = 0; i < PIXELS; i++) {
        float from[3], along[3];
        dist_camera_ray(&camera, (float)(i % SIDE), (float)(i / SIDE), from, along);
        double down = (double)along[1], at = -(double)from[1] / down; /* where the ray meets the sheet */
        double x = (double)from[0] + at * (double)along[0], z = (double)from[2] + at * (double)along[2];
        if (!(down < -0.05) || x * x + z * z > 0.8) continue;
        CHECK_EQUAL(1, picture_a.mask[i]);
        passed += (double)from[1] + (double)picture_a.distance[i] * down < -0.5 * (double)sheet->gap;
    }
    return passed;
}

/* A sample in the solid says that the ray ends before it, not where: the sheet comes first. */
TEST(no_sheet_before_a_solid_is_passed)
{
    dist_context *ctx = shape_context();
    const float halves[4] = {2e-5f, 1e-4f, 5e-4f, 1e-3f}, gaps[4] = {2e-3f, 5e-3f, 1e-2f, 2e-2f};
    for (int certified = 0; certified < 2; certified++) {
        for (int k = 0; k < 16; k++) {
            test_sheet sheet = {halves[k / 4], gaps[k % 4]};
            dist_render_desc how = plain_how();
            how.certified = certified;
            int passed = sheet_passed(ctx, &sheet, &how);
            if (test_state.verbose)
                printf("    %g thin, %g before%s: %d passed\n", 2 * (double)sheet.half, (double)sheet.gap,
                       certified ? ", certified" : "", passed);
            if (certified || sheet.half > 4e-4f) CHECK_EQUAL(0, passed);
        }
    }
    dist_context_destroy(ctx);
}

/* A wire over a slope, both seen at a low angle. */
typedef struct test_wire {
    double radius, at[3], along[3], up[3]; /* a point of it and its unit direction; normal of the slope through 0 */
} test_wire;

static double wire_value(const test_wire *wire, const double p[3], int *on_wire)
{
    double e[3], slope = 0, along = 0, square = 0;
    for (int k = 0; k < 3; k++) {
        e[k] = p[k] - wire->at[k];
        slope += wire->up[k] * p[k];
        along += wire->along[k] * e[k];
    }
    for (int k = 0; k < 3; k++) square += (e[k] - along * wire->along[k]) * (e[k] - along * wire->along[k]);
    double near = sqrt(square) - wire->radius;
    *on_wire = near < slope;
    return fmin(near, slope);
}

static void wire_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const test_wire *wire = (const test_wire *)user;
    (void)worker;
    (void)gradient; /* not asked for */
    for (size_t i = 0; i < n; i++) {
        double p[3] = {(double)points[3 * i], (double)points[3 * i + 1], (double)points[3 * i + 2]};
        int on_wire;
        sdf[i] = (float)wire_value(wire, p, &on_wire);
    }
}

/* What the neighbors' hits foretell lies behind it: a certified ray may not go there but by steps that are proven. */
TEST(no_wire_before_a_surface_is_passed_by_certified_pictures)
{
    dist_context *ctx = shape_context();
    const float eye[3] = {0, 0.35f, 2.2f}, middle[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(WIDE, WIDE, 1.0f, eye, middle, up);
    int seen = 0, passed[2] = {0, 0};
    for (int k = 0; k < 16; k++) {
        test_wire wire = {6e-4, {3e-3 * k, 0.02 + 0.03 * k, 0.25}, {0.8, 0, 0.6}, {0, cos(0.02), sin(0.02)}};
        dist_field field;
        memset(&field, 0, sizeof field);
        field.user = &wire;
        field.eval_fn = wire_eval;
        field.radius = field.lipschitz = 1;
        dist_render_desc how = plain_how();
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        how.certified = 1;
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_b), ctx);
        for (int i = 0; i < WIDE * WIDE; i++) {
            float o[3], d[3];
            double p[3], t = 1.2, f = 1;
            int on_wire = 0;
            dist_camera_ray(&camera, (float)(i % WIDE), (float)(i / WIDE), o, d);
            for (int step = 0; step < 5000 && f > -1e-6 && t < 3.3; step++, t += fmax(f, 1e-6)) {
                for (int j = 0; j < 3; j++) p[j] = (double)o[j] + t * (double)d[j];
                f = wire_value(&wire, p, &on_wire);
            }
            if (f > -1e-6 || !on_wire || p[0] * p[0] + p[1] * p[1] + p[2] * p[2] > 0.95) continue;
            seen++;
            passed[0] += !picture_a.mask[i] || (double)picture_a.distance[i] > t + 0.01;
            passed[1] += !picture_b.mask[i] || (double)picture_b.distance[i] > t + 0.01;
        }
    }
    if (test_state.verbose) printf("    of %d pixels of wires passed: %d, certified %d\n", seen, passed[0], passed[1]);
    CHECK(seen > 300);
    CHECK_EQUAL(0, passed[1]);
    CHECK(passed[0] * 20 <= seen);
    dist_context_destroy(ctx);
}

/* Up to six boxes, plates, rods and balls together, turned any way: rounded boxes. */
typedef struct test_parts {
    int count;
    double center[6][3], axes[6][3][3], half[6][3], radius[6];
} test_parts;

static double parts_value(const test_parts *parts, const double p[3])
{
    double least = 1e30;
    for (int k = 0; k < parts->count; k++) {
        double out = 0, in = -1e30;
        for (int i = 0; i < 3; i++) {
            double q = 0;
            for (int j = 0; j < 3; j++) q += parts->axes[k][i][j] * (p[j] - parts->center[k][j]);
            q = fabs(q) - parts->half[k][i];
            out += q > 0 ? q * q : 0;
            in = fmax(in, q);
        }
        least = fmin(least, sqrt(out) + fmin(in, 0) - parts->radius[k]);
    }
    return least;
}

static void parts_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        double p[3], ends[2];
        for (int k = 0; k < 3; k++) p[k] = (double)points[3 * i + (size_t)k];
        sdf[i] = (float)parts_value((const test_parts *)user, p);
        for (int k = 0; k < 3 && gradient; k++) {
            for (int e = 0; e < 2; e++) {
                double at[3] = {p[0], p[1], p[2]};
                at[k] += e ? 1e-5 : -1e-5;
                ends[e] = parts_value((const test_parts *)user, at);
            }
            gradient[3 * i + (size_t)k] = (float)((ends[1] - ends[0]) / 2e-5);
        }
    }
}

static test_parts parts_make(test_random *r, float thin)
{
    test_parts parts;
    parts.count = 1 + (int)test_random_float(r, 0, 5.99f);
    for (int k = 0; k < parts.count; k++) {
        float x[3], y[3], size = test_random_float(r, 0.05f, 0.3f);
        int kind = (int)test_random_float(r, 0, 3.99f); /* how many sides are as thin as the rounding */
        test_random_direction(r, x);
        test_random_direction(r, y);
        double dot = 0, length = 0;
        for (int i = 0; i < 3; i++) dot += (double)x[i] * (double)y[i];
        for (int i = 0; i < 3; i++) {
            parts.axes[k][0][i] = (double)x[i];
            parts.axes[k][1][i] = (double)y[i] - dot * (double)x[i];
            length += parts.axes[k][1][i] * parts.axes[k][1][i];
            parts.center[k][i] = (double)test_random_float(r, -0.4f, 0.4f);
            parts.half[k][i] = i < kind ? 0 : (double)test_random_float(r, 0.05f, 0.3f);
        }
        for (int i = 0; i < 3; i++) parts.axes[k][1][i] /= sqrt(length);
        for (int i = 0; i < 3; i++) {
            int j = (i + 1) % 3, l = (i + 2) % 3;
            parts.axes[k][2][i] = parts.axes[k][0][j] * parts.axes[k][1][l] - parts.axes[k][0][l] * parts.axes[k][1][j];
        }
        parts.radius[k] = kind == 3 ? (double)size : (double)(thin * test_random_float(r, 1, 4));
    }
    return parts;
}

/* Where a ray first meets the parts, marched in double; 0: nowhere, -1: it goes in by less than 1e-4 of the radius. */
static double parts_meet(const test_parts *parts, const float o[3], const float d[3])
{
    double p[3], f = 1, t = 0.4;
    for (; t < 3.2 && f > 1e-6; t += f) {
        for (int i = 0; i < 3; i++) p[i] = (double)o[i] + t * (double)d[i];
        f = parts_value(parts, p);
    }
    if (f > 1e-6) return 0;
    for (double s = t; s < t + 2e-3; s += 2e-5) {
        for (int i = 0; i < 3; i++) p[i] = (double)o[i] + s * (double)d[i];
        if (parts_value(parts, p) < -1e-4) return t;
    }
    return -1;
}

/* Thin parts before, behind and beside others. The default tracer takes steps on trust; certified ones are proven. */
TEST(one_hit_in_a_thousand_is_lost_of_random_thin_parts_and_none_certified)
{
    dist_context *ctx = shape_context();
    int scenes = test_quick() ? 12 : 60, crossing = 0, lost[2] = {0, 0}, broken[2] = {0, 0};
    for (int k = 0; k < scenes; k++) {
        test_random r = test_random_seed(100 + (unsigned)k);
        test_parts parts = parts_make(&r, 5e-4f);
        float eye[3];
        const float middle[3] = {0, 0, 0}, up[3] = {0, 1, 0};
        test_random_direction(&r, eye);
        for (int i = 0; i < 3; i++) eye[i] *= 2;
        dist_camera camera = dist_camera_look_at(64, 64, 0.7f, eye, middle, up);
        dist_field field;
        memset(&field, 0, sizeof field);
        field.user = &parts;
        field.eval_fn = parts_eval;
        field.radius = field.lipschitz = 1;
        dist_render_desc how = plain_how();
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        how.certified = 1;
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_b), ctx);
        for (int i = 0; i < 64 * 64; i++) {
            float o[3], d[3];
            dist_camera_ray(&camera, (float)(i % 64), (float)(i / 64), o, d);
            double t = parts_meet(&parts, o, d);
            crossing += t > 0;
            for (int c = 0; c < 2 && t > 0; c++) {
                const picture *p = c ? &picture_b : &picture_a;
                double off = (double)p->distance[i] - t;
                lost[c] += !p->mask[i] || off > 2e-3;
                broken[c] += p->mask[i] && fabs(off) > (double)p->error[i] + 1e-4;
            }
        }
    }
    if (test_state.verbose)
        printf("    %d crossing; lost %d, certified %d; beyond their bound %d, %d\n", crossing, lost[0], lost[1],
               broken[0], broken[1]);
    CHECK(crossing > 300 * scenes);
    CHECK(lost[0] * 1000 <= crossing);
    CHECK(broken[0] * 1000 <= crossing);
    CHECK_EQUAL(0, lost[1]);
    CHECK_EQUAL(0, broken[1]);
    dist_context_destroy(ctx);
}

/* The far figure bounds slopes where f is large: a looser one costs queries and loses nothing; bad ones are refused. */
TEST(lipschitz_far_holds_where_f_is_large)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(side(), side());
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.certified = 1;
    test_shape shape = shape_make(SHAPE_BOX, 0.6, 0.5, 5e-4, 0);
    dist_field field = shape_field(&shape, 1, 1), plain = field;
    field.lipschitz_far = 2.0f; /* a looser bound: the same picture at more queries */
    CHECK_STATUS(DIST_OK, picture_render(ctx, &plain, &camera, &how, &picture_a), ctx);
    CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_b), ctx);
    CHECK(picture_b.stats.queries > picture_a.stats.queries);
    CHECK_EQUAL(0, judge(&shape, &camera, 1, 1, 1e-5, &picture_b).missed);
    field.lipschitz_far = -1.0f;
    CHECK_EQUAL(DIST_BAD_ARGUMENT, picture_render(ctx, &field, &camera, &how, &picture_b));
    how.certified = 2;
    CHECK_EQUAL(DIST_BAD_ARGUMENT, picture_render(ctx, &plain, &camera, &how, &picture_b));
    dist_context_destroy(ctx);
}

/* A network of zeros: the steps of certified rays are not all spent on it. */
TEST(what_is_0_everywhere_ends_certified_rays_after_a_thousand_steps)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_CONSTANT, 0, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    dist_camera camera = shape_camera(16, 16);
    dist_render_desc how = plain_how();
    how.certified = 1;
    CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
    CHECK(picture_a.stats.plateau > 0 && picture_a.stats.hits == 0);
    CHECK(picture_a.stats.queries < 1010 * picture_a.stats.rays_in_sphere);
    dist_context_destroy(ctx);
}

TEST(cones_change_no_pixel)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(side(), side());
    dist_render_desc how = plain_how();
    how.no_cones = 1;
    shape_case cases[CASES + 2];
    shape_cases(cases);
    cases[CASES] = cases[0];
    cases[CASES].name = "rods";
    cases[CASES].shape = shape_make(SHAPE_RODS, 1e-3, 0, 0, 0);
    cases[CASES + 1] = cases[0];
    cases[CASES + 1].name = "plate";
    cases[CASES + 1].shape = shape_make(SHAPE_BOX, 0.6, 0.5, 5e-5, 0);
    for (int k = 0; k < CASES + 2; k++) {
        dist_field field = shape_field(&cases[k].shape, cases[k].radius, cases[k].lipschitz);
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, NULL, &picture_a), ctx);
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_b), ctx);
        int masks = 0, off = 0, touching = 0;
        for (int i = 0; i < side() * side(); i++) {
            double o[3], d[3], t0 = 0, t1 = 0;
            shape_pixel(&camera, i % side(), i / side(), o, d);
            int differs = picture_a.mask[i] != picture_b.mask[i];
            double far = fabs((double)picture_a.distance[i] - (double)picture_b.distance[i]);
            double bound = (double)picture_a.error[i] + (double)picture_b.error[i] + 2e-6;
            if (!differs && !(picture_a.mask[i] && far > bound)) continue;
            shape_enter(o, d, 1, &t0, &t1);
            shape_crossing c = shape_cross(&cases[k].shape, o, d, t0, t1, cases[k].exact, 1e-5, 1e-4);
            if (c.touched || (!c.crosses && c.least < 1e-4) || (c.crosses && c.below < 2e-6)) touching++;
            else if (differs) masks++;
            else off++;
        }
        int good = CHECK_EQUAL(0, masks) & CHECK_EQUAL(0, off) & CHECK(touching <= 10);
        CHECK(picture_b.stats.cone_queries == 0);
        if (!good || test_state.verbose)
            printf("    %s: masks %d, distances %d, rays that touch %d; queries %llu with, %llu without\n",
                   cases[k].name, masks, off, touching, picture_a.stats.queries, picture_b.stats.queries);
    }
    dist_context_destroy(ctx);
}

/* ---- single rays ------------------------------------------------------------------------------------------------ */

/* Traces one ray against a shape; notes gets its queries unless NULL. */
static dist_hit trace_one(dist_context *ctx, test_shape *shape, double radius, double lipschitz, const float o[3],
                          const float d[3], const dist_render_desc *how, float *notes)
{
    dist_hit hit;
    memset(&hit, 0, sizeof hit);
    shape->queries = 0;
    shape->notes = notes;
    dist_field field = shape_field(shape, radius, lipschitz);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, o, d, how, &hit, NULL), ctx);
    return hit;
}

static float notes[4 * SHAPE_NOTES];

/* 1 */
TEST(grazing_rays_hit_within_the_bound_or_say_that_they_are_unresolved)
{
    dist_context *ctx = shape_context();
    const double degrees[12] = {90, 60, 30, 20, 10, 5, 3, 2, 1, 0.5, 0.2, 0.1};
    long most = 0;
    for (int k = 0; k < 12; k++) {
        for (int j = 0; j < 8; j++) {
            double angle = degrees[k] * 3.14159265358979323846 / 180, tilt = 0.3 * j;
            double n[3] = {0.36 * cos(tilt) + 0.48 * sin(tilt), 0.48 * cos(tilt) - 0.36 * sin(tilt), 0.8};
            double length = shape_length(n[0], n[1], n[2]);
            for (int i = 0; i < 3; i++) n[i] /= length;
            double u[3] = {n[1], -n[0], 0};
            length = shape_length(u[0], u[1], u[2]);
            test_shape plane = shape_make(SHAPE_PLANE, n[0], n[1], n[2], 0);
            float o[3], d[3];
            for (int i = 0; i < 3; i++) {
                double along = cos(angle) * u[i] / length - sin(angle) * n[i];
                d[i] = (float)along;
                o[i] = (float)(0.003 * j * u[i] - 1.5 * along); /* it meets the plane near 0 */
            }
            dist_hit hit = trace_one(ctx, &plane, 1, 1, o, d, NULL, NULL);
            most = plane.queries > most ? plane.queries : most;
            double from = n[0] * (double)o[0] + n[1] * (double)o[1] + n[2] * (double)o[2];
            double by = n[0] * (double)d[0] + n[1] * (double)d[1] + n[2] * (double)d[2];
            double size = shape_length((double)d[0], (double)d[1], (double)d[2]), expected = -from / by * size;
            CHECK(hit.status == DIST_RAY_HIT || hit.status == DIST_RAY_UNRESOLVED);
            if (degrees[k] >= 3) CHECK_EQUAL(DIST_RAY_HIT, hit.status);
            if (hit.status == DIST_RAY_HIT)
                CHECK_NEAR(expected, hit.distance, (double)hit.error + 1e-6 + 2e-7 / sin(angle));
            else CHECK(fabs((double)hit.sdf) < 1e-2);
        }
        if (degrees[k] >= 10) CHECK(most <= 33); /* the paper's rule at alpha 1.5 */
    }
    dist_context_destroy(ctx);
}

static long queries_after_crossing(const test_shape *shape)
{
    long at = 0;
    while (at < shape->queries && notes[4 * at + 3] > 0) at++;
    return at < shape->queries ? shape->queries - at - 1 : -1;
}

/* 2: the Lipschitz figure is wrong for all of these, so that the surface is crossed. Without a clamp it is half the
   truth, or the first step would leave the sphere. */
TEST(twelve_queries_finish_98_of_100_rays_once_they_have_crossed)
{
    dist_context *ctx = shape_context();
    const double slopes[6] = {1.2, 1.33, 2, 5, 100, 1000};
    long most = 0;
    int crossed = 0, over = 0, rays = test_quick() ? 200 : 1000;
    for (int k = 0; k < 6; k++) {
        for (int kind = 0; kind < 6; kind++) {
            test_random r = test_random_seed(3);
            test_shape shape = kind < 2   ? shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0)
                               : kind < 4 ? shape_make(SHAPE_BOX, 0.5, 0.4, 0.45, 0)
                                          : shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
            int worse = 0;
            shape.slope = slopes[k];
            shape.clamp = kind % 2 ? 0.1 : 0;
            for (int j = 0; j < rays; j++) {
                float o[3], d[3];
                test_random_direction(&r, o);
                for (int i = 0; i < 3; i++) {
                    o[i] *= 2.0f;
                    d[i] = test_random_float(&r, -0.7f, 0.7f) - o[i];
                }
                dist_hit hit =
                    trace_one(ctx, &shape, 1, shape.clamp > 0 ? 1 : fmax(1, 0.5 * slopes[k]), o, d, NULL, notes);
                long after = queries_after_crossing(&shape);
                if (after < 0) continue;
                crossed++;
                worse += after > 12;
                most = after > most ? after : most;
                CHECK_EQUAL(DIST_RAY_HIT, hit.status);
                double p[3], length = shape_length((double)d[0], (double)d[1], (double)d[2]);
                for (int i = 0; i < 3; i++) p[i] = (double)o[i] + (double)hit.distance * (double)d[i] / length;
                CHECK_NEAR(0, shape_exact(&shape, p), (double)hit.error + 2e-6);
            }
            over += worse;
            if (worse && test_state.verbose)
                printf("    slope %g%s, kind %d: %d of %d rays over\n", slopes[k], kind % 2 ? ", clamped" : "",
                       kind / 2, worse, rays);
        }
    }
    CHECK(crossed > rays * 12);
    CHECK(most <= 26);
    CHECK(over * 50 <= crossed);
    if (test_state.verbose || over * 50 > crossed)
        printf("    at most %ld queries after the crossing, %d of %d rays over 12\n", most, over, crossed);
    dist_context_destroy(ctx);
}

/* 3 */
TEST(small_slopes_finish_or_report_with_an_honest_bound)
{
    dist_context *ctx = shape_context();
    const double slopes[4] = {0.3, 0.1, 0.05, 0.01};
    for (int k = 0; k < 4; k++) {
        int hits = 0;
        for (int j = 0; j < 40; j++) {
            test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
            shape.slope = slopes[k];
            float o[3] = {0, 0, 2.5f}, d[3] = {0.005f * (float)j, 0, -1};
            dist_hit hit = trace_one(ctx, &shape, 1, 1, o, d, NULL, NULL);
            double length = shape_length((double)d[0], 0, 1), along = 2.5 / length, off = 2.5 * (double)d[0] / length;
            double expected = along - sqrt(0.36 - off * off);
            hits += hit.status == DIST_RAY_HIT;
            CHECK(hit.status == DIST_RAY_HIT || hit.status == DIST_RAY_UNRESOLVED);
            if (hit.status == DIST_RAY_HIT)
                CHECK_NEAR(expected, hit.distance, (double)hit.error + 2e-6 + 1e-7 / slopes[k]);
            else CHECK((double)hit.sdf > 0);
        }
        if (test_state.verbose) printf("    slope %g: %d of 40 hit\n", slopes[k], hits);
        if (slopes[k] >= 0.05) CHECK_EQUAL(40, hits);
    }
    dist_context_destroy(ctx);
}

/* 4, 20 */
TEST(rays_beside_the_sphere_tell_where_they_are_nearest_to_its_center)
{
    const float rays[3][7] = {{0, 5, -3, 0, 0, 1, 3}, {0, 0.3f, -0.2f, 0, 0, 2, 0.2f}, {0, 5, 3, 0, 0, 1, 0}};
    dist_context *ctx = shape_context();
    for (int k = 0; k < 3; k++) { /* the last one has it behind itself */
        float ball[4] = {0, 0, 0, 0.1f};
        dist_field field = dist_field_sphere(ball);
        dist_hit hit;
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, rays[k], rays[k] + 3, NULL, &hit, NULL), ctx);
        CHECK_EQUAL(DIST_RAY_MISS, hit.status);
        CHECK_NEAR((double)rays[k][6], hit.distance, 1e-6);
        CHECK(hit.sdf > 2e38f);
    }
    dist_context_destroy(ctx);
}

TEST(constant_fields_end_within_the_budget_with_the_right_status)
{
    dist_context *ctx = shape_context();
    const double values[8] = {1, 0.3, 1e-2, 1e-3, 2.5e-5, 0, -0.3, -2.5e-5};
    const int expected[8] = {DIST_RAY_MISS,   DIST_RAY_MISS,  -1, -1, DIST_RAY_PLATEAU, DIST_RAY_PLATEAU,
                             DIST_RAY_INSIDE, DIST_RAY_INSIDE};
    for (int k = 0; k < 8; k++) {
        test_shape shape = shape_make(SHAPE_CONSTANT, values[k], 0, 0, 0);
        float o[3] = {0.1f, 0.2f, 2.5f}, d[3] = {0, 0, -1};
        dist_hit hit = trace_one(ctx, &shape, 1, 1, o, d, NULL, NULL);
        CHECK(shape.queries <= 300);
        if (expected[k] >= 0) CHECK_EQUAL(expected[k], hit.status);
        else CHECK(hit.status == DIST_RAY_MISS || hit.status == DIST_RAY_UNRESOLVED || hit.status == DIST_RAY_PLATEAU);
        CHECK(test_finite((double)hit.distance));
        CHECK_NEAR(values[k], hit.sdf, 1e-7);
    }
    dist_context_destroy(ctx);
}

/* 7 */
TEST(a_camera_inside_the_sphere_starts_at_itself_and_ends_at_the_exit)
{
    dist_context *ctx = shape_context();
    test_random r = test_random_seed(3);
    for (int k = 0; k < 200; k++) {
        test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
        float o[3] = {0, test_random_float(&r, 0.25f, 0.7f), 0}, d[3];
        test_random_direction(&r, d);
        dist_hit hit = trace_one(ctx, &shape, 1, 1, o, d, NULL, notes);
        double from[3], v[3], t0, t1, length = shape_length((double)d[0], (double)d[1], (double)d[2]);
        for (int i = 0; i < 3; i++) {
            from[i] = (double)o[i];
            v[i] = (double)d[i] / length;
        }
        CHECK(shape_enter(from, v, 1, &t0, &t1));
        CHECK_NEAR(0, t0, 0);
        for (long i = 0; i < shape.queries; i++) {
            double t = 0;
            for (int j = 0; j < 3; j++) t += ((double)notes[4 * i + j] - from[j]) * v[j];
            CHECK(t > -1e-6 && t < t1 + 1e-6);
            if (i == 0) CHECK_NEAR(0, t, 1e-6);
        }
        shape_crossing c = shape_cross(&shape, from, v, t0, t1, 1, 1e-5, 1e-4);
        if (c.touched || (c.crosses && c.below < 1e-6) || (!c.crosses && c.least < 1e-4)) continue;
        CHECK_EQUAL(c.crosses ? DIST_RAY_HIT : DIST_RAY_MISS, hit.status);
        if (c.crosses) CHECK_NEAR(c.t, hit.distance, (double)hit.error + 1e-6);
    }
    dist_context_destroy(ctx);
}

/* 8 */
TEST(a_camera_inside_the_solid_gets_what_the_desc_says)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0);
    test_random r = test_random_seed(4);
    for (int k = 0; k < 100; k++) {
        float o[3], d[3];
        test_random_fill(&r, 3, o, -0.39f, 0.39f);
        test_random_direction(&r, d);
        dist_render_desc how = plain_how();
        how.inside = DIST_INSIDE_BACKGROUND;
        dist_hit hit = trace_one(ctx, &shape, 1, 1, o, d, &how, NULL);
        CHECK_EQUAL(DIST_RAY_INSIDE, hit.status);
        CHECK_EQUAL(1, shape.queries);
        how.inside = DIST_INSIDE_HIT;
        hit = trace_one(ctx, &shape, 1, 1, o, d, &how, NULL);
        CHECK_EQUAL(DIST_RAY_INSIDE, hit.status);
        CHECK(hit.distance == 0.0f);
        how.inside = DIST_INSIDE_EXIT;
        hit = trace_one(ctx, &shape, 1, 1, o, d, &how, NULL);
        CHECK_EQUAL(DIST_RAY_HIT, hit.status);
        double along = 0, square = 0, length = shape_length((double)d[0], (double)d[1], (double)d[2]);
        for (int i = 0; i < 3; i++) {
            along += (double)o[i] * (double)d[i] / length;
            square += (double)o[i] * (double)o[i];
        }
        CHECK_NEAR(-along + sqrt(along * along - square + 0.49), hit.distance, (double)hit.error + 1e-6);
    }
    dist_context_destroy(ctx);
}

/* The paper's tracer goes back out of a solid, behind the camera: that ray started inside, however it was steered. */
#ifndef DIST_NO_PAPER
TEST(the_papers_tracer_knows_a_camera_in_the_solid)
{
    enum { W = 24 };
    float ball[4] = {0, 0, 0, 0.9f}, eye[3] = {0.05f, 0.02f, -0.05f}, at[3] = {0.1f, 0.1f, 0}, distance[W * W];
    unsigned char mask[W * W], status[W * W];
    dist_context *ctx = shape_context();
    dist_field field = dist_field_sphere(ball);
    dist_camera camera = dist_camera_look_at(W, W, 0.7f, eye, at, NULL);
    field.radius = 1;
    for (int k = 0; k < 4 * 3 * 2; k++) {
        dist_render_desc how;
        dist_images out;
        int other = 0, masked = 0, behind = 0;
        memset(&how, 0, sizeof how);
        memset(&out, 0, sizeof out);
        how.trace = DIST_TRACE_PAPER;
        how.paper_row = k % 4;
        how.step_scale = k / 4 % 3 == 1 ? 2.5f : 0.0f;
        how.max_steps = k / 4 % 3 == 2 ? 4 : 0;
        how.inside = k / 12 ? DIST_INSIDE_HIT : DIST_INSIDE_BACKGROUND;
        out.distance = distance;
        out.mask = mask;
        out.status = status;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        for (int i = 0; i < W * W; i++) {
            other += status[i] != DIST_RAY_INSIDE;
            masked += mask[i];
            behind += masked && distance[i] != 0.0f;
        }
        CHECK_EQUAL(0, other);
        CHECK_EQUAL(0, behind);
        CHECK_EQUAL(k / 12 ? W * W : 0, masked);
    }
    dist_context_destroy(ctx);
}
#endif

/* Where f is a tenth of the distance, exactly as declared, steps that nothing proves must be as short as elsewhere. */
TEST(a_field_of_small_slope_hides_nothing)
{
    enum { N = 3000 };
    static float origins[3 * N], directions[3 * N];
    static dist_hit hits[N];
    dist_context *ctx = shape_context();
    for (int k = 0; k < 4; k++) {
        test_shape shape = shape_make(k & 1 ? SHAPE_TORUS : SHAPE_RODS, k & 1 ? 0.5 : 0.15, 0.2, 0, 0);
        test_random random = test_random_seed(21 + (unsigned)k);
        int missed = 0, crossing = 0;
        shape.slope = 0.1;
        dist_field field = shape_field(&shape, 1.3, k < 2 ? 0.1 : 0.15);
        for (int round = 0; round < 3; round++) {
            make_rays(&random, &shape, N, origins, directions);
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, N, origins, directions, NULL, hits, NULL), ctx);
            for (int i = 0; i < N; i++) {
                double o[3], d[3], size = 0, deepest = 1;
                for (int j = 0; j < 3; j++) {
                    o[j] = (double)origins[3 * i + j];
                    d[j] = (double)directions[3 * i + j];
                    size += d[j] * d[j];
                }
                for (int j = 0; j < 3; j++) d[j] /= sqrt(size);
                for (double t = 0; t < 4 && deepest >= -0.01; t += 0.02)
                    deepest = fmin(deepest, shape_along(&shape, o, d, t));
                if (!(deepest < -0.01)) continue;
                crossing++;
                missed += hits[i].status == DIST_RAY_MISS;
            }
        }
        CHECK(crossing > 1000);
        CHECK_EQUAL(0, missed);
        if (test_state.verbose) printf("    slope %g: %d of %d missed\n", shape.slope, missed, crossing);
    }
    dist_context_destroy(ctx);
}

/* 9 */
TEST(a_ray_that_starts_on_the_surface_leaves_it)
{
    dist_context *ctx = shape_context();
    test_random r = test_random_seed(5);
    int stuck = 0, wrong = 0;
    for (int k = 0; k < 300; k++) {
        test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
        float n[3], d[3], o[3];
        test_random_direction(&r, n);
        test_random_direction(&r, d);
        double away = 0;
        for (int i = 0; i < 3; i++) away += (double)n[i] * (double)d[i];
        for (int i = 0; i < 3; i++) {
            o[i] = 0.500001f * n[i]; /* just outside, whatever rounding does */
            if (away < 0) d[i] = -d[i];
        }
        if (fabs(away) < 0.05) continue;
        dist_hit hit = trace_one(ctx, &shape, 1, 1, o, d, NULL, NULL);
        stuck += shape.queries > 60;
        wrong += hit.status != DIST_RAY_MISS;
        for (int i = 0; i < 3; i++) d[i] = -d[i];
        hit = trace_one(ctx, &shape, 1, 1, o, d, NULL, NULL);
        wrong += hit.status != DIST_RAY_HIT || fabs((double)hit.distance) > 1e-4;
    }
    CHECK_EQUAL(0, stuck);
    CHECK_EQUAL(0, wrong);
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    const float exact[3] = {0, 0, 0.5f}, up[3] = {0, 0, 1}, down[3] = {0, 0, -1}, along[3] = {1, 0, 0};
    CHECK_EQUAL(DIST_RAY_MISS, trace_one(ctx, &shape, 1, 1, exact, up, NULL, NULL).status);
    CHECK_EQUAL(DIST_RAY_MISS, trace_one(ctx, &shape, 1, 1, exact, along, NULL, NULL).status);
    CHECK(shape.queries <= 60);
    CHECK_NEAR(0, trace_one(ctx, &shape, 1, 1, exact, down, NULL, NULL).distance, 1e-4);
    dist_context_destroy(ctx);
}

TEST(the_bounding_sphere_itself_is_no_obstacle)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    const float on[3] = {0, 0, 1}, in[3] = {0, 0, -1}, out[3] = {0, 0, 1}, along[3] = {1, 0, 0}, off[3] = {-3, 0, 1};
    dist_hit hit = trace_one(ctx, &shape, 1, 1, on, in, NULL, NULL);
    CHECK_EQUAL(DIST_RAY_HIT, hit.status);
    CHECK_NEAR(0.5, hit.distance, (double)hit.error + 1e-6);
    CHECK_EQUAL(DIST_RAY_MISS, trace_one(ctx, &shape, 1, 1, on, out, NULL, NULL).status);
    CHECK_EQUAL(0, shape.queries);
    CHECK_EQUAL(DIST_RAY_MISS, trace_one(ctx, &shape, 1, 1, on, along, NULL, NULL).status);
    CHECK(shape.queries <= 1);
    CHECK_EQUAL(DIST_RAY_MISS, trace_one(ctx, &shape, 1, 1, off, along, NULL, NULL).status); /* a tangent */
    CHECK(shape.queries <= 1);
    dist_context_destroy(ctx);
}

/* 11 */
TEST(far_origins_hit_what_double_hits)
{
    dist_context *ctx = shape_context();
    const double away[5] = {1, 1e2, 1e4, 1e6, 1e12};
    for (int k = 0; k < 5; k++) {
        test_random r = test_random_seed(6);
        int hits = 0;
        for (int j = 0; j < 400; j++) {
            test_shape shape = shape_make(SHAPE_SPHERE, 0.7, 0, 0, 0);
            float u[3], o[3], d[3];
            double from[3], v[3], length = 0, along = 0, square = 0;
            test_random_direction(&r, u);
            for (int i = 0; i < 3; i++) {
                o[i] = (float)(away[k] * (double)u[i] * 1.5);
                d[i] = (float)(-(double)o[i] + test_random_double(&r, -0.6, 0.6));
                from[i] = (double)o[i];
                v[i] = (double)d[i];
                length += v[i] * v[i];
            }
            for (int i = 0; i < 3; i++) along -= from[i] * v[i] / sqrt(length);
            for (int i = 0; i < 3; i++) {
                double q = from[i] + along * v[i] / sqrt(length);
                square += q * q;
            }
            dist_hit hit = trace_one(ctx, &shape, 1, 1, o, d, NULL, NULL);
            double off = sqrt(square);
            if (fabs(off - 0.7) < 1e-4 + 1e-14 * away[k]) continue; /* the outline */
            CHECK_EQUAL(off < 0.7 ? DIST_RAY_HIT : DIST_RAY_MISS, hit.status);
            if (off > 0.7 || hit.status != DIST_RAY_HIT) continue;
            hits++;
            double expected = along - sqrt(0.49 - square), grazing = sqrt(0.49 - square) / 0.7;
            CHECK_NEAR(expected, hit.distance,
                       (double)hit.error + (2e-6 + 1e-14 * away[k]) / fmax(grazing, 0.05));
            CHECK((double)hit.error < 1e-4 / fmax(grazing, 1e-2) + 1.1 * 6e-8 * expected);
        }
        CHECK(hits > 50 || away[k] > 1e7);
    }
    dist_context_destroy(ctx);
}

/* 14 */
TEST(no_epsilon_is_too_small)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(64, 64);
    const float epsilons[5] = {0, 1e-30f, 1e-12f, 5e-8f, 1e-6f};
    for (int k = 0; k < 5; k++) {
        test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        how.epsilon = epsilons[k];
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        verdict v = judge(&shape, &camera, 1, 1, 1e-5, &picture_a);
        CHECK_EQUAL(0, v.missed);
        CHECK_EQUAL(0, v.phantom);
        CHECK(picture_a.stats.epsilon >= 1e-7f && picture_a.stats.epsilon >= epsilons[k] &&
              picture_a.stats.epsilon <= 1e-4f);
        CHECK(picture_a.stats.queries < 64 * 64 * 20);
        if (k > 0 && k < 4) CHECK(v.broken * 1000 <= v.judged);
    }
    dist_context_destroy(ctx);
}

/* 16 */
TEST(every_step_scale_converges_and_the_others_are_refused)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(64, 64);
    const float good[7] = {0.5f, 1, 1.5f, 1.99f, 2, 2.5f, 10};
    test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    dist_render_desc how = plain_how();
    for (int k = 0; k < 7; k++) {
        for (int cones = 0; cones < 2; cones++) {
            how.step_scale = good[k];
            how.no_cones = cones;
            CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
            verdict v = judge(&shape, &camera, 1, 1, 1e-5, &picture_a);
            CHECK_EQUAL(0, v.missed);
            CHECK_EQUAL(0, v.phantom);
            CHECK(v.broken * 1000 <= v.judged);
        }
    }
    uint32_t infinite = 0x7f800000u;
    float bad[4] = {-1, -1e-30f, test_nan(), 0};
    memcpy(bad + 3, &infinite, sizeof infinite);
    for (int k = 0; k < 4; k++) {
        dist_context_clear(ctx);
        how.step_scale = bad[k];
        CHECK_STATUS(DIST_BAD_ARGUMENT, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        CHECK_TEXT("step_scale", dist_context_message(ctx));
    }
    dist_context_destroy(ctx);
}

/* 18 */
TEST(the_nearest_of_two_surfaces_is_hit)
{
    dist_context *ctx = shape_context();
    const double thick[6] = {1e-1, 1e-3, 1e-5, 1e-6, 2.4e-7, 6e-8};
    const double gaps[4] = {0.1, 1e-3, 1e-5, 6e-8};
    for (int k = 0; k < 6; k++) {
        for (int g = 0; g < 4; g++) {
            for (int j = 0; j < 20; j++) {
                test_shape pair = shape_make(SHAPE_PAIR, thick[k], gaps[g], 0, 0);
                float d[3] = {0.02f * (float)j, -0.03f, -1};
                float o[3] = {0.05f * (float)j - 0.5f - 2 * d[0], 0.1f - 2 * d[1], 2.0f + 0.013f * (float)j};
                dist_hit hit = trace_one(ctx, &pair, 1, 1, o, d, NULL, NULL);
                double length = shape_length((double)d[0], (double)d[1], 1);
                CHECK_EQUAL(DIST_RAY_HIT, hit.status);
                /* where a plate is thinner than epsilon the hit may be anywhere within epsilon of it */
                if (!CHECK_NEAR((double)o[2] * length, hit.distance,
                                (double)hit.error + 2e-6 + (thick[k] < 1e-4 ? 5.1e-5 * length : 0)))
                    printf("    %g thick, %g apart, ray %d\n", thick[k], gaps[g], j);
            }
        }
    }
    for (int j = 0; j < 20; j++) {
        test_shape shells = shape_make(SHAPE_SHELLS, 1e-4, 0, 0, 0);
        float o[3] = {0, 0, 2}, d[3] = {0.017f * (float)j, 0, -1};
        dist_hit hit = trace_one(ctx, &shells, 1, 1, o, d, NULL, NULL);
        double size = shape_length((double)d[0], 0, 1), off = 2 * (double)d[0] / size, outer = 0.7 + 5e-5;
        CHECK_EQUAL(DIST_RAY_HIT, hit.status);
        CHECK_NEAR(2 / size - sqrt(outer * outer - off * off), hit.distance, (double)hit.error + 2e-6);
    }
    dist_context_destroy(ctx);
}

/* 22 */
TEST(nan_from_the_field_is_not_finite_and_no_hit)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    shape.poison = 0.2;
    dist_field field = shape_field(&shape, 1, 1);
    dist_render_desc how = plain_how();
    for (int cones = 0; cones < 2; cones++) {
        float o[3 * 50], d[3 * 50];
        dist_hit hits[50];
        dist_stats stats;
        for (size_t j = 0; j < 50; j++) {
            o[3 * j] = 0.8f * ((float)j / 50.0f - 0.5f);
            o[3 * j + 1] = 0;
            o[3 * j + 2] = 2;
            d[3 * j] = d[3 * j + 1] = 0;
            d[3 * j + 2] = -1;
        }
        how.no_cones = cones;
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 50, o, d, &how, hits, &stats), ctx);
        unsigned long long bad = 0;
        for (size_t j = 0; j < 50; j++) {
            double x = fabs((double)o[3 * j]);
            CHECK(test_finite((double)hits[j].distance) && test_finite((double)hits[j].error) &&
                  test_finite((double)hits[j].sdf));
            if (x > 0.201) CHECK_EQUAL(DIST_RAY_HIT, hits[j].status);
            if (x < 0.15) CHECK_EQUAL(DIST_RAY_NOT_FINITE, hits[j].status);
            bad += hits[j].status == DIST_RAY_NOT_FINITE;
        }
        CHECK(bad == stats.not_finite && bad > 10);
    }
    dist_context_destroy(ctx);
}

/* 31 */
TEST(a_surface_without_slope_ends_within_the_budget)
{
    dist_context *ctx = shape_context();
    int hits = 0;
    for (int j = 0; j < 30; j++) {
        test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
        shape.power = 3;
        float o[3] = {0.01f * (float)j, 0, 1.5f}, d[3] = {0, 0, -1};
        dist_hit hit = trace_one(ctx, &shape, 1, 1, o, d, NULL, NULL);
        double expected = 1.5 - sqrt(0.36 - (double)o[0] * (double)o[0]);
        CHECK(shape.queries <= 140);
        CHECK(hit.status == DIST_RAY_HIT || hit.status == DIST_RAY_UNRESOLVED || hit.status == DIST_RAY_PLATEAU);
        hits += hit.status == DIST_RAY_HIT;
        /* |f| / |df/dt| says too little at a triple root: epsilon is what holds there */
        if (hit.status == DIST_RAY_HIT) CHECK_NEAR(expected, hit.distance, fmax((double)hit.error, 5e-5));
    }
    if (test_state.verbose) printf("    %d of 30 hit\n", hits);
    dist_context_destroy(ctx);
}

/* f is never negative: a solid whose inside is 0. */
static void hollow_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i;
        float length = sqrtf(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]), f = length - *(const float *)user;
        sdf[i] = f > 0 ? f : 0;
        for (int k = 0; k < 3 && gradient; k++) gradient[3 * i + (size_t)k] = f > 0 ? p[k] / length : 0;
    }
}

/* The Lipschitz figure is too small: cones and other rays' spheres lead into the solid. */
TEST(a_solid_whose_inside_is_0_ends_within_the_budget)
{
    dist_context *ctx = shape_context();
    float radius = 0.6f;
    dist_field field;
    memset(&field, 0, sizeof field);
    field.user = &radius;
    field.eval_fn = hollow_eval;
    field.radius = 1;
    field.lipschitz = 0.5f;
    for (int k = 0; k < 4; k++) { /* pixels of different widths are predicted differently */
        dist_camera camera = shape_camera(32 << k, 32 << k);
        dist_render_desc how = plain_how();
        how.max_steps = k % 2 ? 30 : 0;
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        CHECK(picture_a.stats.hits > 100u << (2 * k));
        CHECK(picture_a.stats.queries < 20 * picture_a.stats.hits + 2000);
    }
    dist_context_destroy(ctx);
}

/* ---- budgets, statuses, free rays ------------------------------------------------------------------------------- */

TEST(no_ray_asks_more_than_its_budget_and_twenty)
{
    dist_context *ctx = shape_context();
    const int budgets[6] = {1, 2, 5, 12, 30, 100};
    shape_case cases[CASES];
    shape_cases(cases);
    test_random r = test_random_seed(7);
    long over = 0;
    for (int k = 0; k < CASES; k++) {
        for (int b = 0; b < 6; b++) {
            for (int j = 0; j < 60; j++) {
                float o[3], d[3];
                test_random_direction(&r, o);
                for (int i = 0; i < 3; i++) {
                    o[i] *= 2.0f;
                    d[i] = test_random_float(&r, -0.7f, 0.7f) - o[i];
                }
                dist_render_desc how = plain_how();
                how.max_steps = budgets[b];
                trace_one(ctx, &cases[k].shape, 1, cases[k].lipschitz, o, d, &how, NULL);
                over = cases[k].shape.queries - budgets[b] > over ? cases[k].shape.queries - budgets[b] : over;
            }
        }
    }
    if (test_state.verbose) printf("    at most %ld over\n", over);
    CHECK(over <= 20);
    dist_context_destroy(ctx);
}

/* Each status against what the ray really meets; a spent budget gives the best of its samples. */
TEST(statuses_are_truthful)
{
    dist_context *ctx = shape_context();
    const int budgets[4] = {3, 6, 12, 100};
    shape_case cases[CASES];
    shape_cases(cases);
    test_random r = test_random_seed(8);
    int seen[6] = {0, 0, 0, 0, 0, 0}, wrong = 0;
    for (int j = 0; j < 2000; j++) {
        shape_case *c = &cases[j % CASES];
        float o[3], d[3];
        double from[3], v[3], t0, t1;
        test_random_direction(&r, o);
        for (int i = 0; i < 3; i++) {
            o[i] *= j % 3 ? 2.0f : 0.9f;
            d[i] = test_random_float(&r, -0.9f, 0.9f) - o[i];
            from[i] = (double)o[i];
            v[i] = (double)d[i];
        }
        double length = shape_length(v[0], v[1], v[2]);
        for (int i = 0; i < 3; i++) v[i] /= length;
        dist_render_desc how = plain_how();
        how.max_steps = budgets[j % 4];
        dist_hit hit = trace_one(ctx, &c->shape, 1, c->lipschitz, o, d, &how, notes);
        if (!CHECK(hit.status >= 0 && hit.status <= DIST_RAY_NOT_FINITE)) continue;
        seen[hit.status]++;
        CHECK(hit.status != DIST_RAY_NOT_FINITE);
        if (!shape_enter(from, v, 1, &t0, &t1)) {
            CHECK_EQUAL(DIST_RAY_MISS, hit.status);
            continue;
        }
        shape_crossing x = shape_cross(&c->shape, from, v, t0, t1, c->exact, 1e-5, 1e-4);
        if (hit.status == DIST_RAY_MISS) wrong += x.crosses && x.below > 2e-6;
        if (hit.status == DIST_RAY_HIT) wrong += !x.crosses && x.least > 1.1e-4;
        if (hit.status == DIST_RAY_INSIDE) wrong += !(shape_exact(&c->shape, from) < 0 || x.t - t0 < 1e-6);
        double p[3];
        for (int i = 0; i < 3; i++) p[i] = from[i] + (double)hit.distance * v[i];
        double f = shape_value(&c->shape, p);
        if (hit.status == DIST_RAY_HIT) CHECK_NEAR(f, hit.sdf, 1.1e-4);
        if (hit.status != DIST_RAY_UNRESOLVED) continue;
        double least = 1e30;
        for (long i = 0; i < c->shape.queries; i++) least = fmin(least, fabs((double)notes[4 * i + 3]));
        CHECK_NEAR(least, hit.sdf, 1e-9);
        CHECK_NEAR(f, hit.sdf, 2e-6);
    }
    CHECK_EQUAL(0, wrong);
    CHECK(seen[DIST_RAY_MISS] > 100 && seen[DIST_RAY_HIT] > 100 && seen[DIST_RAY_UNRESOLVED] > 20);
    dist_context_destroy(ctx);
}

TEST(free_rays_take_directions_of_any_length)
{
    dist_context *ctx = shape_context();
    const float lengths[6] = {1, 2e-38f, 1e-20f, 1e-6f, 1e6f, 1e38f};
    for (int k = 0; k < 6; k++) {
        test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
        float o[3] = {0.1f, 0.2f, 2}, d[3] = {0, 0, -lengths[k]};
        dist_hit hit = trace_one(ctx, &shape, 1, 1, o, d, NULL, NULL);
        CHECK_EQUAL(DIST_RAY_HIT, hit.status);
        CHECK_NEAR(2 - sqrt(0.25 - 0.05), hit.distance, (double)hit.error + 1e-6);
    }
    dist_context_destroy(ctx);
}

TEST(free_rays_without_a_direction_are_not_finite)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    uint32_t infinite = 0x7f800000u;
    float inf;
    memcpy(&inf, &infinite, sizeof inf);
    const float o[5][3] = {{0, 0, 2}, {0, 0, 2}, {0, 0, 2}, {test_nan(), 0, 2}, {0, inf, 2}};
    const float d[5][3] = {{0, 0, 0}, {0, test_nan(), -1}, {inf, 0, -1}, {0, 0, -1}, {0, 0, -1}};
    for (int k = 0; k < 5; k++) {
        dist_hit hit = trace_one(ctx, &shape, 1, 1, o[k], d[k], NULL, NULL);
        CHECK_EQUAL(DIST_RAY_NOT_FINITE, hit.status);
        CHECK_EQUAL(0, shape.queries);
        CHECK(test_finite((double)hit.distance) && test_finite((double)hit.error) && test_finite((double)hit.sdf));
    }
    dist_context_destroy(ctx);
}

/* Many rays are the same as each by itself, and their counts are the sum. */
TEST(many_free_rays_are_the_same_as_single_ones)
{
    enum { RAYS = 2500 };
    static float o[3 * RAYS], d[3 * RAYS];
    static dist_hit hits[RAYS];
    dist_context *ctx = shape_context();
    test_random r = test_random_seed(9);
    unsigned long long queries = 0, counts[6] = {0, 0, 0, 0, 0, 0};
    test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    dist_stats stats;
    test_random_fill(&r, 3 * RAYS, o, -1.5f, 1.5f);
    test_random_fill(&r, 3 * RAYS, d, -1.0f, 1.0f);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, o, d, NULL, hits, &stats), ctx);
    for (int i = 0; i < RAYS; i++) {
        dist_hit one = trace_one(ctx, &shape, 1, 1, o + 3 * i, d + 3 * i, NULL, NULL);
        CHECK_BYTES(sizeof one, &one, &hits[i]);
        queries += (unsigned long long)shape.queries;
        counts[hits[i].status]++;
    }
    CHECK(stats.rays == RAYS && stats.queries == queries);
    CHECK(stats.queries == stats.march_queries + stats.refine_queries && stats.cone_queries == 0);
    CHECK(stats.hits == counts[DIST_RAY_HIT] && stats.inside == counts[DIST_RAY_INSIDE]);
    CHECK(stats.unresolved == counts[DIST_RAY_UNRESOLVED] && stats.plateau == counts[DIST_RAY_PLATEAU]);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 0, NULL, NULL, NULL, NULL, &stats), ctx);
    CHECK(stats.rays == 0 && stats.queries == 0);
    dist_context_destroy(ctx);
}

/* A clamp says nothing of the surface: however small, as many rays hit, within half of it. */
TEST(clamps_below_the_default_epsilon_hide_no_surface)
{
    enum { SMALL = 24, N = SMALL * SMALL };
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SMALL, SMALL);
    unsigned long long hits = 0;
    static float depth[2][N];
    for (int k = 0; k < 5; k++) {
        const double clamps[5] = {0, 1e-3, 8e-5, 2e-5, 4e-6};
        test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
        shape.clamp = clamps[k];
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        dist_images out;
        dist_stats stats;
        memset(&out, 0, sizeof out);
        out.depth = depth[k > 0];
        out.stats = &stats;
        field.clamp = (float)clamps[k];
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        if (k == 0) hits = stats.hits;
        CHECK_EQUAL(hits, stats.hits);
        if (k) CHECK(stats.epsilon <= 0.5f * field.clamp);
        for (int i = 0; i < N; i++) CHECK(fabsf(depth[k > 0][i] - depth[0][i]) < 1e-3f);
    }
    CHECK(hits > 50);
    dist_context_destroy(ctx);
}

TEST(trace_refuses_what_it_cannot_trace)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    const float o[3] = {0, 0, 2}, d[3] = {0, 0, -1};
    const unsigned char pixel = 1;
    for (int k = 0; k < 23; k++) {
        dist_field field = shape_field(&shape, 1, 1);
        dist_render_desc how = plain_how();
        const char *part = "field";
        dist_hit hit;
        int f = 1, origin = 1, direction = 1, result = 1;
        if (k == 0) f = 0;
        if (k == 1) origin = 0, part = "origins";
        if (k == 2) direction = 0, part = "directions";
        if (k == 3) result = 0, part = "hits";
        if (k == 4) field.eval_fn = NULL;
        if (k == 5) field.radius = 0, part = "radius";
        if (k == 6) field.radius = test_nan(), part = "radius";
        if (k == 7) field.center[1] = test_nan(), part = "center";
        if (k == 8) field.lipschitz = -1, part = "lipschitz";
        if (k == 9) field.clamp = test_nan(), part = "clamp";
        if (k == 10) how.max_steps = -1, part = "max_steps";
        if (k == 11) how.epsilon = -1e-3f, part = "epsilon";
        if (k == 12) how.epsilon = test_nan(), part = "epsilon";
        if (k == 13) how.inside = 3, part = "inside";
        if (k == 14) how.lipschitz = test_nan(), part = "lipschitz";
        if (k == 15) how.samples = 9, part = "samples";
        if (k == 16) how.trace = 2, part = "trace";
        if (k == 17) how.normal_delta = -1, part = "normal_delta";
        if (k == 18) field.certified = -1, part = "field.certified";
        if (k == 19) field.certified_far = test_nan(), part = "field.certified_far";
        if (k == 20) how.pixels = &pixel, part = "how.pixels is for pictures";
        if (k == 21) how.trace = DIST_TRACE_PAPER, how.certified = 1, part = "how.certified is for DIST_TRACE_GUARDED";
        if (k == 22) how.normal_delta = 1e-8f, part = "normal_delta is 1e-8, must be 1e-6 to 1 of";
        dist_context_clear(ctx);
        shape.queries = 0;
        CHECK_STATUS(DIST_BAD_ARGUMENT,
                     dist_trace(ctx, f ? &field : NULL, 1, origin ? o : NULL, direction ? d : NULL, &how,
                                result ? &hit : NULL, NULL),
                     ctx);
        CHECK_TEXT("dist_trace: ", dist_context_message(ctx));
        CHECK_TEXT(part, dist_context_message(ctx));
        CHECK_EQUAL(0, shape.queries);
    }
    dist_context_destroy(ctx);
}

/* ---- the paper's tracer ----------------------------------------------------------------------------------------- */

static dist_render_desc paper_how(int row, int steps)
{
    dist_render_desc how = plain_how();
    how.trace = DIST_TRACE_PAPER;
    how.paper_row = row;
    how.max_steps = steps;
    return how;
}

TEST(each_row_of_the_ladder_asks_less_than_the_one_before)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    unsigned long long queries[4];
    for (int row = 0; row < 4; row++) {
        dist_render_desc how = paper_how(row, 50);
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        queries[row] = picture_a.stats.queries;
        verdict v = judge(&shape, &camera, 1, 1, 1e-5, &picture_a);
        CHECK(v.missed * 50 <= v.crossing);
        CHECK_EQUAL(0, v.phantom);
        if (test_state.verbose)
            printf("    row %d: %llu queries, %d of %d missed, %d unresolved, worst %.1e\n", row, queries[row],
                   v.missed, v.crossing, v.unresolved, v.worst);
    }
    CHECK(queries[DIST_PAPER_PARALLEL] > queries[DIST_PAPER_DYNAMIC]);
    CHECK(queries[DIST_PAPER_DYNAMIC] > queries[DIST_PAPER_AGGRESSIVE]);
    CHECK(queries[DIST_PAPER_AGGRESSIVE] > queries[DIST_PAPER_COARSE_TO_FINE]);
    CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, NULL, &picture_a), ctx);
    CHECK(queries[DIST_PAPER_COARSE_TO_FINE] > picture_a.stats.queries);
    if (test_state.verbose) printf("    guarded: %llu queries\n", picture_a.stats.queries);
    dist_context_destroy(ctx);
}

/* 2: contracts while alpha * slope < 2. */
TEST(the_paper_converges_up_to_slope_1_2_and_not_from_1_34_on)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_pinhole();
    const double slopes[8] = {0.3, 0.6, 1, 1.2, 1.34, 1.5, 2, 5};
    for (int k = 0; k < 8; k++) {
        test_shape plane = shape_make(SHAPE_PLANE, 0, 0, -1, -0.7213);
        plane.slope = slopes[k];
        dist_field field = shape_field(&plane, 1, slopes[k]);
        dist_render_desc how = paper_how(DIST_PAPER_AGGRESSIVE, 100);
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        CHECK_EQUAL(slopes[k] < 1.3, picture_a.mask[0]);
        if (slopes[k] > 1.3) CHECK_EQUAL(DIST_RAY_UNRESOLVED, picture_a.status[0]);
        how = plain_how();
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        CHECK_EQUAL(1, picture_a.mask[0]);
        CHECK_NEAR(0.7213, picture_a.distance[0], (double)picture_a.error[0] + 1e-6);
    }
    dist_context_destroy(ctx);
}

/* ---- error bounds ------------------------------------------------------------------------------------------------ */

/* picture_a is traced and compared with picture_b, the truth: of the hits that are also the truth's, 999 of 1000 at
   least must be off by no more than their error and the truth's together. Hits where the truth has none are false, and
   at most 1 in 1000, like those of which the truth is not known. With a `how` of its own: 2 in 1000. Of fewer than 1000
   hits one may be beyond. */
static void bound_check(dist_context *ctx, const char *name, const dist_field *field, const dist_camera *camera,
                        const dist_render_desc *how)
{
    int hits = 0, held = 0, both = 0, phantom = 0, unknown = 0;
    double worst = 0;
    CHECK_STATUS(DIST_OK, picture_render(ctx, field, camera, how, &picture_a), ctx);
    for (int i = 0; i < camera->width * camera->height; i++) {
        if (!picture_a.mask[i]) continue;
        hits++;
        if (!picture_b.mask[i]) {
            phantom += picture_b.status[i] == DIST_RAY_MISS;
            unknown += picture_b.status[i] != DIST_RAY_MISS;
            continue;
        }
        double off = fabs((double)picture_a.distance[i] - (double)picture_b.distance[i]);
        double over = off - (double)picture_a.error[i] - (double)picture_b.error[i];
        both++;
        held += over <= 0;
        worst = fmax(worst, over);
    }
    int good = CHECK(both > 0) & CHECK(held >= 0.999 * both || both - held == 1) &
               CHECK(phantom * 1000 <= (how ? 2 : 1) * hits) &
               CHECK(unknown <= 2 + hits / 1000); /* flat at float noise */
    if (!good || test_state.verbose)
        printf("    %s: hits %d, within the bound %.3f %%, beyond it by %.1e at most, false %d, truth unknown %d\n",
               name, hits, 100.0 * held / (both > 0 ? both : 1), worst, phantom, unknown);
}

static void bound_check_shape(dist_context *ctx, const char *name, const shape_case *c, const dist_camera *camera)
{
    test_shape shape = c->shape;
    dist_field field = shape_field(&shape, c->radius, c->lipschitz);
    for (int i = 0; i < camera->width * camera->height; i++) {
        double o[3], d[3], t0, t1;
        shape_crossing cross;
        memset(&cross, 0, sizeof cross);
        shape_pixel(camera, i % camera->width, i / camera->width, o, d);
        if (shape_enter(o, d, c->radius, &t0, &t1)) cross = shape_cross(&shape, o, d, t0, t1, c->exact, 1e-5, 0);
        picture_b.mask[i] = (unsigned char)cross.crosses;
        picture_b.status[i] = cross.crosses ? DIST_RAY_HIT : DIST_RAY_MISS;
        picture_b.distance[i] = (float)cross.t;
        picture_b.error[i] = 1.2e-7f * (float)cross.t; /* of rounding to float */
    }
    bound_check(ctx, name, &field, camera, NULL);
    unsigned long long hits = picture_a.stats.hits, cones = picture_a.stats.cone_queries;
    field.cost = 1; /* smaller cones along the outline, but no balls */
    bound_check(ctx, name, &field, camera, NULL);
    CHECK(picture_a.stats.cone_queries > cones || camera->width < 256);
    CHECK(picture_a.stats.hits + hits / 1000 >= hits && picture_a.stats.hits <= hits + hits / 1000);
    field.cost = -1;
    CHECK_EQUAL(DIST_BAD_ARGUMENT, picture_render(ctx, &field, camera, NULL, &picture_a));
    dist_context_clear(ctx);
}

/* The truth is a certified picture to 1e-7 with twice the steepest slopes that were sampled. */
static void bound_check_decoder(dist_context *ctx, const char *path, int code)
{
    char name[96];
    dist_camera camera = shape_camera(bound_side(), bound_side());
    dist_net *net = dist_net_load_file(ctx, path);
    dist_shape *shape = net ? dist_shape_create(ctx, net, code >= 0 ? dist_net_code(net, code) : NULL) : NULL;
    const char *file = strrchr(path, '/');
    (void)snprintf(name, sizeof name, "%s, code %d", file ? file + 1 : path, code);
    if (CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx)) {
        dist_field field = dist_shape_field(shape), steep = field;
        dist_render_desc how = plain_how();
        how.certified = 1;
        how.epsilon = 1e-7f;
        how.max_steps = 20000;
        steep.certified *= 2.0f;
        steep.certified_far *= 2.0f;
        CHECK_STATUS(DIST_OK, picture_render(ctx, &steep, &camera, &how, &picture_b), ctx);
        bound_check(ctx, name, &field, &camera, NULL);
        how.certified = how.max_steps = 0;
        how.epsilon = 1e-2f; /* what comes near without a crossing is no hit for that */
        bound_check(ctx, name, &field, &camera, &how);
        how.epsilon = 1e-4f;
        bound_check(ctx, name, &field, &camera, &how);
        how.epsilon = 1e-6f; /* where f is flat before the surface, not what a step of this size would tell */
        bound_check(ctx, name, &field, &camera, &how);
    }
    dist_shape_destroy(shape);
    dist_net_destroy(net);
}

/* dist_stats.steepest: 0 where the figure is a bound; where it is not, more than it and no more than the true one. */
TEST(a_slope_beyond_the_lipschitz_figure_is_reported)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    shape_case cases[CASES];
    shape_cases(cases);
    for (int certified = 0; certified < 2; certified++) {
        dist_render_desc how = plain_how();
        how.certified = certified;
        for (int k = 0; k < CASES; k++) {
            test_shape shape = cases[k].shape;
            dist_field field = shape_field(&shape, cases[k].radius, cases[k].lipschitz);
            CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
            CHECK_NEAR(0, picture_a.stats.steepest, 0);
        }
        const double amplitude[3] = {0.02, 0.05, 0.1}, slope[3] = {1, 1, 2.5}; /* stiff: slopes to 1 + 80 amplitude */
        for (int k = 0; k < 3; k++) {
            test_shape shape = shape_make(SHAPE_BUMPY, 0.6, amplitude[k], 80, 0);
            shape.slope = slope[k];
            double most = slope[k] * (1 + 80 * amplitude[k]);
            dist_field field = shape_field(&shape, 1, 1.125);
            CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
            CHECK((double)picture_a.stats.steepest > 1.125 && (double)picture_a.stats.steepest <= 1.001 * most);
            if (test_state.verbose)
                printf("    slope %.2f: figure 1.125, met %.3f\n", most, (double)picture_a.stats.steepest);
            how.lipschitz = (float)(1.001 * most);
            CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
            CHECK_NEAR(0, picture_a.stats.steepest, 0);
            how.lipschitz = 0;
            field.certified = (float)(1.001 * most); /* the field's, near and far, for certified rays alone */
            CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
            CHECK_NEAR(certified ? field.certified : 1.125f, picture_a.stats.lipschitz, 0);
            CHECK((picture_a.stats.steepest > 0) == !certified);
        }
    }
    dist_context_destroy(ctx);
}

/* Nobody has told the figure of a field of one's own: the picture of a sphere three times as steep is empty, and says
   why; one of slope 1 says nothing, and small ones, and those without stats, cost nothing. */
TEST(a_steep_field_whose_figure_nobody_told_is_told_of)
{
    static float origins[3 * PIXELS], directions[3 * PIXELS];
    static dist_hit hits[PIXELS];
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int i = 0; i < PIXELS; i++)
        dist_camera_ray(&camera, (float)(i % SIDE), (float)(i / SIDE), origins + 3 * i, directions + 3 * i);
    for (int k = 0; k < 5; k++) {
        const double slopes[5] = {1, 1.5, 3, 30, 0.2};
        test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
        shape.slope = slopes[k];
        for (int told = 0; told < 2; told++) {
            dist_field field = shape_field(&shape, 1, told ? slopes[k] : 0);
            double expected = !told && slopes[k] > 1 ? slopes[k] : 0;
            for (int certified = 0; certified < 2; certified++) {
                dist_render_desc how = plain_how();
                dist_stats stats, few;
                dist_images out;
                how.certified = certified;
                memset(&out, 0, sizeof out);
                out.mask = picture_a.mask;
                long before = shape.queries;
                CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
                long plain = shape.queries - before;
                out.stats = &stats;
                CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
                CHECK_NEAR(expected, stats.steepest, 1e-3 * expected);
                CHECK(stats.hits > 0 || slopes[k] >= 3);
                CHECK_EQUAL(plain + (told ? 0 : 80), stats.queries);
                CHECK_EQUAL(before + 2 * plain + (told ? 0 : 80), shape.queries);
                CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, PIXELS, origins, directions, &how, hits, &stats), ctx);
                CHECK_NEAR(expected, stats.steepest, 1e-3 * expected);
                CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 255, origins, directions, &how, hits, &few), ctx);
                CHECK_NEAR(0, few.steepest, 0); /* none of them nears the sphere */
                how.max_queries = stats.queries - 1;
                CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, PIXELS, origins, directions, &how, hits, &few), ctx);
                CHECK(few.queries <= how.max_queries);
                how.max_queries = 0;
                how.lipschitz = (float)slopes[k];
                CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, PIXELS, origins, directions, &how, hits, &stats), ctx);
                CHECK(!(stats.steepest > 0) && stats.hits > PIXELS / 20);
            }
        }
    }
    dist_context_destroy(ctx);
}

/* A sphere three to five times as steep as is said: rays step over it. Where the samples of the silhouette find the
   solid, the ray is not told to be a miss, and the figure that it takes is told, though no ray met it. */
TEST(a_solid_that_only_the_silhouette_finds_is_no_miss)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    for (int k = 3; k <= 5; k++) {
        test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
        int found = 0, missed = 0;
        shape.slope = k;
        dist_field field = shape_field(&shape, 1, 1);
        dist_images out;
        memset(&out, 0, sizeof out);
        out.distance = picture_a.distance;
        out.silhouette = picture_b.distance; /* not looked at */
        out.error = picture_a.error;
        out.status = picture_a.status;
        out.stats = &picture_a.stats;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < PIXELS; i++) {
            float origin[3], direction[3];
            double along = 0, square = 0;
            dist_camera_ray(&camera, (float)(i % SIDE), (float)(i / SIDE), origin, direction);
            for (int j = 0; j < 3; j++) {
                along -= (double)origin[j] * (double)direction[j];
                square += (double)origin[j] * (double)origin[j];
            }
            double aside = square - along * along, truth = along - sqrt(fmax(0.36 - aside, 0.0));
            missed += picture_a.status[i] == DIST_RAY_MISS && aside < 0.35; /* fewer than half */
            if (picture_a.status[i] != DIST_RAY_UNRESOLVED) continue;
            found++;
            CHECK(aside < 0.36);
            CHECK_NEAR(truth, picture_a.distance[i], (double)picture_a.error[i] + 1e-5);
        }
        CHECK(found > 100 && missed < 2000);
        CHECK(picture_a.stats.unresolved == (unsigned long long)found);
        CHECK(picture_a.stats.steepest > 2.0f && picture_a.stats.steepest < 1.001f * (float)k);
        if (test_state.verbose)
            printf("    slope %d: %d found, %d missed, met %.2f\n", k, found, missed, (double)picture_a.stats.steepest);
    }
    test_shape all = shape_make(SHAPE_SPHERE, 1.4, 0, 0, 0); /* but a ray within a solid that has no end does miss it */
    dist_field field = shape_field(&all, 1, 1);
    const float eye[3] = {0.3f, 0.2f, 0.5f};
    dist_render_desc how = plain_how();
    how.inside = DIST_INSIDE_EXIT;
    camera = dist_camera_look_at(SIDE, SIDE, 0.7f, eye, NULL, NULL);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.silhouette = picture_b.distance;
    out.stats = &picture_a.stats;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
    CHECK(picture_a.stats.unresolved == 0 && picture_a.stats.steepest <= 0);
    dist_context_destroy(ctx);
}

/* Two balls, the smaller one first: (center z, radius) of each. */
static void two_balls(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const float(*ball)[2] = (const float(*)[2])user;
    (void)worker;
    (void)gradient; /* traces ask for none */
    for (size_t i = 0; i < n; i++, points += 3) {
        double f[2];
        for (int k = 0; k < 2; k++)
            f[k] = shape_length((double)points[0], (double)points[1], (double)points[2] - (double)ball[k][0]) -
                   (double)ball[k][1];
        sdf[i] = (float)fmin(f[0], f[1]);
    }
}

/* However early a march ends, its hit is the first solid to within its error: what its last step may have passed over
   counts as well. */
TEST(few_steps_bound_what_they_may_have_passed)
{
    float ball[2][2] = {{0.6f, 0.05f}, {0.2f, 0.3f}}, to[3] = {0, 0, -1};
    dist_context *ctx = shape_context();
    dist_field field;
    int hits = 0, broken = 0, narrow = 0;
    memset(&field, 0, sizeof field);
    field.user = ball;
    field.eval_fn = two_balls;
    field.radius = 1;
    field.detail = 0.02f;
    for (int steps = 1; steps <= 12; steps++) {
        for (int i = 0; i < 800; i++) {
            float from[3] = {0, -0.2f + 0.0005f * (float)i, 1.5f};
            dist_render_desc how = plain_how();
            dist_hit hit;
            how.max_steps = steps;
            how.certified = i % 2;
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, from, to, &how, &hit, NULL), ctx);
            if (hit.status != DIST_RAY_HIT) continue;
            double first = 1e30;
            for (int k = 0; k < 2; k++) {
                double square = (double)ball[k][1] * (double)ball[k][1] - (double)from[1] * (double)from[1];
                if (square > 0) first = fmin(first, 1.5 - (double)ball[k][0] - sqrt(square));
            }
            hits++;
            if (first > 1e29) continue; /* within epsilon of an outline */
            narrow += hit.error < 1e-4f;
            broken += fabs((double)hit.distance - first) > (double)hit.error + 1e-4;
        }
    }
    CHECK_EQUAL(0, broken);
    CHECK(hits > 3000 && narrow > 2000);
    if (test_state.verbose) printf("    %d hits, %d of them with an error below 1e-4\n", hits, narrow);
    dist_context_destroy(ctx);
}

/* Beside a ball by less than floats can tell f may rise by noise alone where its slope is looked for. */
TEST(no_error_is_below_0)
{
    dist_context *ctx = shape_context();
    test_random r = test_random_seed(9);
    int hits = 0, below = 0;
    for (int k = 0; k < 20000; k++) {
        double slope = pow(10, test_random_double(&r, -1.5, 0)), radius = pow(10, test_random_double(&r, -2.5, -0.2));
        test_shape shape = shape_make(SHAPE_SPHERE, radius, 0, 0, 0);
        float from[3] = {0, 0, -2}, to[3] = {0, 0, 1};
        dist_render_desc how = plain_how();
        dist_hit hit;
        shape.slope = slope;
        dist_field field = shape_field(&shape, 1, slope);
        field.detail = (float)(0.5 * radius);
        from[0] = (float)(radius + test_random_double(&r, -1e-6, 2e-6) / slope);
        how.epsilon = k % 2 ? 1e-6f : 0.0f;
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, from, to, &how, &hit, NULL), ctx);
        hits += hit.status == DIST_RAY_HIT;
        below += hit.status == DIST_RAY_HIT && !(hit.error >= 0.0f && hit.error < 10.0f);
    }
    CHECK_EQUAL(0, below);
    CHECK(hits > 5000);
    dist_context_destroy(ctx);
}

/* A certified ray whose steps are spent just before a surface that it meets at a slope has not found a plateau. */
TEST(certified_rays_out_of_steps_are_on_no_plateau)
{
    enum { BOXES = 8 };
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(SIDE, SIDE);
    test_random r = test_random_seed(15);
    int unresolved = 0;
    for (int k = 0; k < 40; k++) {
        float box[BOXES][6] = {{0}}, step[7] = {0};
        dist_field one[BOXES];
        dist_instance instance[BOXES];
        memset(instance, 0, sizeof instance);
        for (int i = 0; i < BOXES; i++) {
            test_random_fill(&r, 3, box[i] + 3, 0.02f, 0.5f);
            test_random_fill(&r, 3, step + 1, -3, 3);
            one[i] = dist_field_box(box[i]);
            instance[i].field = &one[i];
            test_random_fill(&r, 3, instance[i].placement.translation, -0.5f, 0.5f);
            dist_similarity_move(&instance[i].placement, step);
        }
        dist_scene *scene = dist_scene_create(ctx, BOXES, instance);
        REQUIRE(scene != NULL);
        dist_field field = dist_scene_field(scene);
        dist_render_desc how = plain_how();
        how.certified = 1;
        how.max_steps = 6 + k % 20;
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        CHECK_EQUAL(0, picture_a.stats.plateau);
        unresolved += (int)picture_a.stats.unresolved;
        dist_scene_destroy(scene);
    }
    CHECK(unresolved > 1000);
    dist_context_destroy(ctx);
}

/* Pixels that a certified picture misses of those hit with a figure twice as large, in all of several views. */
static int missed_of_net(dist_context *ctx, const dist_field *field, int *hits)
{
    int missed = 0;
    *hits = 0;
    for (int view = 0; view < 4; view++) {
        const float eye[3] = {view % 2 ? 1.5f : -1.2f, view < 2 ? 0.9f : -0.4f, view % 3 ? 1.3f : -1.4f};
        const float up[3] = {0, 1, 0};
        dist_camera camera = dist_camera_look_at(WIDE, WIDE, 1.0f, eye, field->center, up);
        dist_render_desc how = plain_how();
        how.certified = 1;
        CHECK_STATUS(DIST_OK, picture_render(ctx, field, &camera, &how, &picture_a), ctx);
        CHECK_NEAR(fmaxf(field->lipschitz, field->certified), picture_a.stats.lipschitz, 0);
        how.lipschitz = 2.0f * fmaxf(field->certified, field->certified_far);
        if (how.lipschitz == 0.0f) how.lipschitz = 6;
        how.max_steps = 60000;
        CHECK_STATUS(DIST_OK, picture_render(ctx, field, &camera, &how, &picture_b), ctx);
        for (int i = 0; i < WIDE * WIDE; i++) {
            *hits += picture_b.mask[i];
            missed += picture_b.mask[i] && !picture_a.mask[i];
        }
    }
    return missed;
}

/* By the slopes of most places of the rings a certified picture misses some; by the steepest that was found, none. */
TEST(certified_pictures_of_nets_miss_nothing)
{
    static const char *const nets[] = {"rings", "fox", "bunny_relu", "round_cross"};
    dist_context *ctx = shape_context();
    FILE *file = fopen(test_data_path("nets/rings.safetensors"), "rb");
    if (!file) dist_context_destroy(ctx);
    if (!file) SKIP("no ../shared/data");
    fclose(file);
    for (int k = 0; k < (test_quick() ? 1 : 4); k++) {
        char name[64];
        int hits = 0;
        (void)snprintf(name, sizeof name, "nets/%s.safetensors", nets[k]);
        dist_net *net = dist_net_load_file(ctx, test_data_path(name));
        dist_shape *shape = dist_shape_create(ctx, net, net ? dist_net_code(net, k == 3 ? 10 : 0) : NULL);
        dist_field field = dist_shape_field(shape), most = field;
        int missed = missed_of_net(ctx, &field, &hits);
        CHECK_EQUAL(0, missed);
        CHECK(hits > 4000 && field.certified > field.lipschitz);
        if (test_state.verbose)
            printf("    %s: slopes of most places %.3f and %.3f, of all %.3f and %.3f; missed %d of %d\n", nets[k],
                   (double)field.lipschitz, (double)field.lipschitz_far, (double)field.certified,
                   (double)field.certified_far, missed, hits);
        most.certified = most.certified_far = 0;
        if (k == 0 && !test_quick()) CHECK(missed_of_net(ctx, &most, &hits) > 0);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    dist_context_destroy(ctx);
}

/* The second picture on a tape begins with the tiles that cost most in the first; whoever traces them, whenever, the
   picture is the same. */
TEST(tiles_that_cost_most_last_time_come_first_and_change_nothing)
{
    enum { WIDTH = 230, HEIGHT = 150 };
    static float depth[3][WIDTH * HEIGHT];
    test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.25, 0, 0);
    dist_field field = shape_field(&shape, 1, 1.125);
    dist_camera camera = shape_camera(WIDTH, HEIGHT);
    for (int k = 0; k < 2; k++) {
        test_scheduler scheduler;
        dist_context_desc desc = test_context_desc();
        dist_images out;
        scheduler.calls = 0;
        scheduler.workers = desc.workers = 1 + 2 * k;
        desc.scheduler = test_scheduler_hook(&scheduler);
        dist_context *ctx = dist_context_create(&desc);
        dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
        REQUIRE(tape != NULL);
        memset(&out, 0, sizeof out);
        for (int turn = 0; turn < 2; turn++) {
            out.depth = depth[k == 0 ? 0 : 1 + turn];
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, tape), ctx);
        }
        inside_tape kept = inside_tape_of(tape);
        int tiles = ((WIDTH - 1) / kept.tiled + 1) * ((HEIGHT - 1) / kept.tiled + 1), seen = 0;
        unsigned most = k == 1 ? kept.cost[kept.order[0]] : 0, last = most;
        for (int i = 0; k == 1 && i < tiles; i++) {
            unsigned cost = kept.cost[kept.order[i]];
            CHECK(cost <= last + most / 60);
            last = cost;
            for (int j = 0; j < tiles; j++) seen += kept.order[j] == i;
        }
        CHECK(k == 0 || (tiles > 8 && seen == tiles && most > 0 && last < most / 2));
        dist_tape_destroy(tape);
        dist_context_destroy(ctx);
    }
    CHECK_BYTES(sizeof depth[0], depth[0], depth[1]);
    CHECK_BYTES(sizeof depth[0], depth[0], depth[2]);
}

/* Against rays that step by at most f / 2.5. */
TEST(the_default_tracer_loses_one_hit_in_ten_thousand_of_the_embedded_family)
{
    dist_context *ctx = shape_context();
    dist_camera camera = shape_camera(64, 64);
    dist_net *net = dist_net_load_file(ctx, "examples/model.safetensors");
    int holes = 0, hits = 0;
    REQUIRE(net != NULL);
    for (int code = 0; code < dist_net_code_count(net); code += test_quick() ? 12 : 3) {
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, code));
        dist_field field = dist_shape_field(shape);
        dist_render_desc how = plain_how();
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_a), ctx);
        how.certified = 1;
        field.lipschitz = 2.5f;
        field.lipschitz_far = 0;
        CHECK_STATUS(DIST_OK, picture_render(ctx, &field, &camera, &how, &picture_b), ctx);
        for (int i = 0; i < 64 * 64; i++) {
            hits += picture_b.mask[i];
            holes += picture_b.mask[i] && !picture_a.mask[i];
        }
        dist_shape_destroy(shape);
    }
    if (test_state.verbose) printf("    %d holes for %d hits\n", holes, hits);
    CHECK(hits > 10000 && holes <= 1 + hits / 10000);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(error_bounds_hold_for_999_hits_of_1000)
{
    dist_context *ctx = shape_context();
    float eye[3] = {2.4f, 0.2f, 0}, at[3] = {0, 0.2f, 0}, up[3] = {0, 1, 0};
    dist_camera camera = shape_camera(bound_side(), bound_side());
    dist_camera grazing = dist_camera_look_at(bound_side(), bound_side(), 0.87f, eye, at, up);
    shape_case cases[CASES], plate, rod;
    shape_cases(cases);
    plate = rod = cases[0];
    plate.shape = shape_make(SHAPE_BOX, 0.6, 0.5, 5e-4, 0);
    rod.shape = shape_make(SHAPE_RODS, 1e-3, 0, 0, 0);
    bound_check_shape(ctx, "sphere", &cases[0], &camera);
    bound_check_shape(ctx, "plate 0.001 thick", &plate, &camera);
    bound_check_shape(ctx, "rods 0.001 thin", &rod, &camera);
    bound_check_shape(ctx, "torus, seen along its top", &cases[1], &grazing);
    bound_check_shape(ctx, "torus of slope 2", &cases[4], &camera);
    bound_check_shape(ctx, "torus clamped at 0.1", &cases[5], &camera);
    bound_check_shape(ctx, "bumps", &cases[6], &camera);
    for (int code = 0; code < 4; code++) bound_check_decoder(ctx, "examples/model.safetensors", 65 * code);
    dist_context_destroy(ctx);
}

TEST(error_bounds_hold_for_999_hits_of_1000_of_real_decoders)
{
    static const char names[][32] = {"fox",        "bunny_relu",      "bob_spot.0", "bob_spot.1",
                                     "rings",      "spot_geometry.0", "chairs.0",   "mug_camera_bottle.0"};
    FILE *probe = fopen(test_data_path("nets/fox.safetensors"), "rb");
    if (!probe) SKIP("no test data: set DIST_DATA");
    fclose(probe);
    dist_context *ctx = test_context();
    for (size_t k = 0; k < (test_quick() ? 3 : sizeof names / sizeof *names); k++) {
        char file[64];
        const char *dot = strchr(names[k], '.');
        if (dist_context_isa(ctx) == DIST_ISA_SCALAR && (names[k][0] == 'c' || names[k][0] == 'm')) {
            printf("    slow surroundings: %s is left out\n", names[k]);
            continue;
        }
        (void)snprintf(file, sizeof file, "nets/%.*s.safetensors", dot ? (int)(dot - names[k]) : 31, names[k]);
        bound_check_decoder(ctx, test_data_path(file), dot ? atoi(dot + 1) : -1);
    }
    dist_context_destroy(ctx);
}

/* ---- real decoders ---------------------------------------------------------------------------------------------- */

static int order_doubles(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return x < y ? -1 : x > y;
}

/* The middle of the reference picture, `size` pixels a side, rendered and compared. */
static void compare_decoder(dist_context *ctx, const char *name, int size)
{
    static double off[PIXELS];
    char base[64], file[96];
    int code = -1, width = 0, height = 0, channels = 0;
    (void)snprintf(base, sizeof base, "%s", name);
    char *dot = strchr(base, '.');
    if (dot) {
        *dot = 0;
        code = atoi(dot + 1);
    }
    (void)snprintf(file, sizeof file, "nets/%s.depth.pfm", name);
    float *expected = dist_pfm_load(ctx, test_data_path(file), &width, &height, &channels);
    (void)snprintf(file, sizeof file, "nets/%s.safetensors", base);
    dist_net *net = dist_net_load_file(ctx, test_data_path(file));
    dist_shape *shape = net ? dist_shape_create(ctx, net, code >= 0 ? dist_net_code(net, code) : NULL) : NULL;
    if (CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx) && CHECK(width == SIDE && height == SIDE)) {
        dist_field field = dist_shape_field(shape);
        dist_camera camera = shape_camera(SIDE, SIDE);
        static float depth[PIXELS];
        dist_images out;
        int first = (SIDE - size) / 2, wrong = 0, inside = 0, hits = 0;
        camera.width = camera.height = size;
        camera.cx -= (float)first;
        camera.cy -= (float)first;
        memset(&out, 0, sizeof out);
        out.depth = depth;
        out.mask = picture_a.mask;
        out.status = picture_a.status;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        for (int i = 0; i < size * size; i++) {
            float e = expected[(first + i / size) * SIDE + first + i % size];
            if (picture_a.status[i] == DIST_RAY_INSIDE) inside++;
            else if ((e > 0) != picture_a.mask[i]) wrong++;
            else if (e > 0) off[hits++] = fabs((double)depth[i] - (double)e);
        }
        qsort(off, (size_t)hits, sizeof *off, order_doubles);
        double p99 = hits ? off[hits * 99 / 100] : 0;
        int good = CHECK(wrong * 500 <= size * size + (size < SIDE) * 500) & CHECK(p99 <= 1e-4) & CHECK(hits > 0);
        if (!good || test_state.verbose)
            printf("    %s: hits %d, wrong %d, inside %d, p50 %.1e, p99 %.1e, worst %.1e\n", name, hits, wrong, inside,
                   hits ? off[hits / 2] : 0.0, p99, hits ? off[hits - 1] : 0.0);
    }
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_pfm_free(ctx, expected, width, height, channels);
    dist_context_clear(ctx);
}

TEST(depth_of_real_decoders_is_that_of_double)
{
    static const char *const names[] = {"bob_spot.0",
                                        "bob_spot.1",
                                        "bunny_relu",
                                        "chairs.1",
                                        "chairs.3",
                                        "deepsdf_512.0",
                                        "deepsdf_512.2",
                                        "deepsdf_512.4",
                                        "deepsdf_512.8",
                                        "deepsdf_512_he.0",
                                        "fox",
                                        "mug_camera_bottle.0",
                                        "mug_camera_bottle.1",
                                        "mug_camera_bottle.2",
                                        "primitives.7",
                                        "primitives.13",
                                        "primitives.15",
                                        "primitives.29",
                                        "rings",
                                        "round_cross.0",
                                        "round_cross.10",
                                        "spot_geometry.0",
                                        "two_spheres_sine"};
    FILE *probe = fopen(test_data_path("nets/fox.safetensors"), "rb");
    if (!probe) SKIP("no test data: set DIST_DATA");
    fclose(probe);
    dist_context *ctx = test_context();
    for (size_t k = 0; k < sizeof names / sizeof *names; k++) {
        int wide = !strncmp(names[k], "deepsdf", 7) || !strncmp(names[k], "chairs", 6);
        int slow = test_quick() || dist_context_isa(ctx) == DIST_ISA_SCALAR;
        if (slow && k % 3) {
            printf("    slow surroundings: %s is left out\n", names[k]);
            continue;
        }
        compare_decoder(ctx, names[k], slow && wide ? 24 : SIDE);
    }
    dist_context_destroy(ctx);
}

/* From the middle on, each tile once, whatever the picture's shape. */
TEST(tiles_go_outward_and_none_is_left_out)
{
    for (int across = 1; across <= 9; across++) {
        for (int down = 1; down <= 9; down++) {
            char seen[81] = {0};
            int n = across * down, ring = 99, bad = 0;
            for (int i = 0; i < n; i++) {
                int tile = inside_tile_outward(across, down, i), x = tile % across, y = tile / across;
                if (tile < 0 || tile >= n || seen[tile]++) {
                    bad++;
                    continue;
                }
                int side = x < across - 1 - x ? x : across - 1 - x, end = y < down - 1 - y ? y : down - 1 - y;
                int now = side < end ? side : end; /* tiles to the border */
                bad += now > ring;
                ring = now;
            }
            CHECK(bad == 0);
        }
    }
}

/* The rays through a sheet are known: a box without depth, or with less than floats can tell, has no sample below 0. */
/* Before it and behind it f adds up to the step over it, to the last bit. */
TEST(a_sheet_without_depth_is_met_head_on)
{
    const float half[4] = {1e-5f, 3e-8f, 1e-8f, 0};
    dist_context *ctx = shape_context();
    for (int t = 0; t < 4; t++) {
        float box[6] = {0, 0, 0, 1, half[t], 1};
        dist_field field = dist_field_box(box);
        int hits = 0;
        for (int i = 0; i < 500; i++) {
            float o[3] = {0.04f * (float)(i % 25 - 12), 1.0f + 0.004f * (float)i, 0.04f * (float)(i / 25 - 10)};
            float d[3] = {0, -1, 0};
            dist_hit hit;
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, o, d, NULL, &hit, NULL), ctx);
            hits += hit.status == DIST_RAY_HIT && fabs((double)o[1] - (double)hit.distance) < 2e-5;
        }
        CHECK_EQUAL(500, hits);
    }
    dist_context_destroy(ctx);
}

TEST(no_sheet_is_too_thin_for_a_certified_ray)
{
    enum { ROW = 60, RAYS = ROW * ROW };
    static const float halves[] = {0.0f, 1e-9f, 1e-8f, 1e-7f, 1e-6f, 1e-3f};
    static float depth[RAYS], origins[3 * RAYS], directions[3 * RAYS];
    static unsigned char mask[RAYS], through[RAYS];
    static dist_hit hits[RAYS];
    dist_context *ctx = shape_context();
    float eye[3] = {1.6f, 0.5f, 1.5f}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(ROW, ROW, 0.7f, eye, NULL, up);
    for (int i = 0; i < RAYS; i++) {
        float *o = origins + 3 * i, *d = directions + 3 * i;
        dist_camera_ray(&camera, (float)(i % ROW), (float)(i / ROW), o, d);
        double t = -(double)o[0] / (double)d[0];
        double y = (double)o[1] + t * (double)d[1], z = (double)o[2] + t * (double)d[2];
        through[i] = fabs(y) < 0.4995 && fabs(z) < 0.4995;
    }
    for (size_t k = 0; k < sizeof halves / sizeof halves[0]; k++) {
        float box[6] = {0, 0, 0, halves[k], 0.5f, 0.5f};
        dist_field field = dist_field_box(box);
        for (int certified = 0; certified < 2; certified++) {
            dist_render_desc how;
            dist_images out;
            memset(&how, 0, sizeof how);
            memset(&out, 0, sizeof out);
            how.certified = certified;
            out.depth = depth;
            out.mask = mask;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, &how, hits, NULL), ctx);
            int rays = 0, lost = 0, lost_free = 0;
            double farthest = 0.0;
            for (int i = 0; i < RAYS; i++) {
                double t = (-(double)halves[k] * (origins[3 * i] < 0.0f ? 1 : -1) - (double)origins[3 * i]) /
                           (double)directions[3 * i];
                if (!through[i]) continue;
                rays++;
                lost += !mask[i];
                lost_free += hits[i].status != DIST_RAY_HIT;
                double off = fabs((double)hits[i].distance - t);
                if (off > farthest) farthest = off;
            }
            CHECK(rays > 600);
            CHECK_EQUAL(0, lost);
            CHECK_EQUAL(0, lost_free);
            CHECK(farthest < 1e-4);
        }
    }
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(every_crossing_is_hit_and_999_of_1000_within_the_error_bound);
    RUN(no_plate_however_thin_is_missed);
    RUN(no_thin_plate_is_missed_by_large_pictures);
    RUN(faces_at_a_grazing_angle_take_one_query_a_pixel_or_so);
    RUN(no_plate_is_missed_silently_at_any_angle);
    RUN(no_rod_thinner_than_a_pixel_is_missed);
    RUN(one_pixel_in_5000_of_a_rod_is_missed_by_large_pictures_and_none_certified);
    RUN(certified_rays_miss_nothing);
    RUN(a_certified_ray_along_which_f_rises_is_on_no_plateau);
    RUN(no_sheet_before_a_solid_is_passed);
    RUN(no_wire_before_a_surface_is_passed_by_certified_pictures);
    RUN(one_hit_in_a_thousand_is_lost_of_random_thin_parts_and_none_certified);
    RUN(lipschitz_far_holds_where_f_is_large);
    RUN(what_is_0_everywhere_ends_certified_rays_after_a_thousand_steps);
    RUN(cones_change_no_pixel);
    RUN(grazing_rays_hit_within_the_bound_or_say_that_they_are_unresolved);
    RUN(twelve_queries_finish_98_of_100_rays_once_they_have_crossed);
    RUN(small_slopes_finish_or_report_with_an_honest_bound);
    RUN(rays_beside_the_sphere_tell_where_they_are_nearest_to_its_center);
    RUN(constant_fields_end_within_the_budget_with_the_right_status);
    RUN(a_camera_inside_the_sphere_starts_at_itself_and_ends_at_the_exit);
    RUN(a_camera_inside_the_solid_gets_what_the_desc_says);
#ifndef DIST_NO_PAPER
    RUN(the_papers_tracer_knows_a_camera_in_the_solid);
#endif
    RUN(a_field_of_small_slope_hides_nothing);
    RUN(a_ray_that_starts_on_the_surface_leaves_it);
    RUN(the_bounding_sphere_itself_is_no_obstacle);
    RUN(far_origins_hit_what_double_hits);
    RUN(no_epsilon_is_too_small);
    RUN(every_step_scale_converges_and_the_others_are_refused);
    RUN(the_nearest_of_two_surfaces_is_hit);
    RUN(nan_from_the_field_is_not_finite_and_no_hit);
    RUN(a_surface_without_slope_ends_within_the_budget);
    RUN(a_solid_whose_inside_is_0_ends_within_the_budget);
    RUN(no_ray_asks_more_than_its_budget_and_twenty);
    RUN(statuses_are_truthful);
    RUN(free_rays_take_directions_of_any_length);
    RUN(free_rays_without_a_direction_are_not_finite);
    RUN(many_free_rays_are_the_same_as_single_ones);
    RUN(clamps_below_the_default_epsilon_hide_no_surface);
    RUN(trace_refuses_what_it_cannot_trace);
    RUN(each_row_of_the_ladder_asks_less_than_the_one_before);
    RUN(the_paper_converges_up_to_slope_1_2_and_not_from_1_34_on);
    RUN(a_slope_beyond_the_lipschitz_figure_is_reported);
    RUN(a_steep_field_whose_figure_nobody_told_is_told_of);
    RUN(a_solid_that_only_the_silhouette_finds_is_no_miss);
    RUN(few_steps_bound_what_they_may_have_passed);
    RUN(no_error_is_below_0);
    RUN(certified_rays_out_of_steps_are_on_no_plateau);
    RUN(certified_pictures_of_nets_miss_nothing);
    RUN(tiles_that_cost_most_last_time_come_first_and_change_nothing);
    RUN(the_default_tracer_loses_one_hit_in_ten_thousand_of_the_embedded_family);
    RUN(error_bounds_hold_for_999_hits_of_1000);
    RUN(error_bounds_hold_for_999_hits_of_1000_of_real_decoders);
    RUN(depth_of_real_decoders_is_that_of_double);
    RUN(tiles_go_outward_and_none_is_left_out);
    RUN(a_sheet_without_depth_is_met_head_on);
    RUN(no_sheet_is_too_thin_for_a_certified_ray);
    return test_report();
}
