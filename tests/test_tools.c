/* SPDX-License-Identifier: MIT-0
   test_tools.c - what tools and games ask of a field: is anything in the way, what is nearest, do these touch; against
   fields worked out in double. */
#include "shapes.h"

#include "model.h"

enum { RAYS = 3000 };

static float origins[3 * RAYS], directions[3 * RAYS], points[4 * RAYS], closest[3 * RAYS], distance[RAYS];
static dist_hit nearest[RAYS], any[RAYS];
static unsigned char status[RAYS];
static dist_contact contacts[RAYS];

static int blocked(const dist_hit *hit)
{
    return hit->status == DIST_RAY_HIT;
}

static float length_of(const float *v)
{
    return sqrtf(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}

TEST(any_hit_finds_a_blocker_where_there_is_one_for_fewer_queries)
{
    dist_context *ctx = shape_context();
    test_shape shapes[SHAPES];
    make_shapes(shapes);
    for (int k = 0; k < SHAPES; k++) {
        test_random random = test_random_seed(3 + (unsigned)k);
        dist_field field = shape_field(&shapes[k], 1, 1);
        dist_render_desc how;
        dist_stats first, second;
        int differ = 0, hits = 0, outside = 0, before = 0;
        memset(&how, 0, sizeof how);
        make_rays(&random, &shapes[k], RAYS, origins, directions);
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, &how, nearest, &first), ctx);
        how.any_hit = 1;
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, &how, any, &second), ctx);
        for (int i = 0; i < RAYS; i++) {
            differ += blocked(&nearest[i]) != blocked(&any[i]);
            if (!blocked(&any[i]) || !blocked(&nearest[i])) continue;
            double p[3], length = 0;
            for (int axis = 0; axis < 3; axis++)
                length += (double)directions[3 * i + axis] * (double)directions[3 * i + axis];
            for (int axis = 0; axis < 3; axis++)
                p[axis] = (double)origins[3 * i + axis] +
                          (double)any[i].distance * (double)directions[3 * i + axis] / sqrt(length);
            hits++;
            outside += shape_value(&shapes[k], p) > 1e-4;
            before += any[i].distance < nearest[i].distance - nearest[i].error - 1e-4f;
        }
        CHECK(hits > RAYS / 10);
        CHECK(differ <= RAYS / 1000); /* rays that graze */
        CHECK_EQUAL(0, outside);
        CHECK_EQUAL(0, before);
        CHECK(second.queries < first.queries);
        if (test_state.verbose)
            printf("    %d hits, queries %llu, any hit %llu\n", hits, first.queries, second.queries);
    }
    dist_context_destroy(ctx);
}

TEST(a_ray_looks_as_far_as_it_is_told_in_lengths_of_its_direction)
{
    dist_context *ctx = shape_context();
    test_shape shapes[SHAPES];
    make_shapes(shapes);
    for (int k = 0; k < SHAPES; k++) {
        test_random random = test_random_seed(13 + (unsigned)k);
        dist_field field = shape_field(&shapes[k], 1, 1);
        dist_render_desc how;
        dist_stats first, second;
        memset(&how, 0, sizeof how);
        make_rays(&random, &shapes[k], RAYS, origins, directions);
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, &how, nearest, &first), ctx);
        for (int both = 0; both < 2; both++) {
            int wrong = 0, cut = 0, hits = 0;
            how.max_distance = 0.8f;
            how.any_hit = both;
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, &how, any, &second), ctx);
            for (int i = 0; i < RAYS; i++) {
                float length = length_of(directions + 3 * i);
                float off = nearest[i].distance - 0.8f * length;
                if (!blocked(&nearest[i])) {
                    wrong += blocked(&any[i]);
                } else if (off > 2e-3f) {
                    wrong += blocked(&any[i]);
                    cut++;
                } else if (off < -2e-3f) {
                    wrong += !blocked(&any[i]);
                    hits++;
                }
            }
            CHECK(cut > 50);
            CHECK(hits > 50);
            CHECK(wrong <= RAYS / 1000);
            CHECK(second.queries < first.queries);
        }
    }
    dist_context_destroy(ctx);
}

/* Without end, in any of the words for it. */
TEST(rays_that_look_beyond_all_floats_look_without_end)
{
    const float most[4] = {0, 3e38f, 3.4e38f, INFINITY};
    float ball[4] = {0, 0, 0, 0.5f}, out[3] = {-1e6f, 0.1f, 0}, ahead[3] = {1, 0, 0};
    dist_context *ctx = shape_context();
    dist_field field = dist_field_sphere(ball);
    dist_hit hit[4];
    for (int i = 0; i < 4; i++) {
        dist_render_desc how;
        memset(&how, 0, sizeof how);
        how.max_distance = most[i];
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, out, ahead, &how, &hit[i], NULL), ctx);
        CHECK_EQUAL(DIST_RAY_HIT, hit[i].status);
        CHECK(hit[i].distance == hit[0].distance);
        CHECK(dist_render_desc_resolve(&how).max_distance == 0.0f);
    }
    dist_context_destroy(ctx);
}

/* However short it looks: a ray that begins in the solid says so. */
TEST(a_ray_that_looks_nowhere_knows_where_it_is)
{
    float ball[4] = {0.2f, 0, 0, 0.5f}, in[3] = {0.3f, 0.2f, 0.1f}, out[3] = {-0.35f, 0.1f, 0}, ahead[3] = {1, 0, 0};
    dist_context *ctx = shape_context();
    dist_field field = dist_field_sphere(ball);
    field.radius = 1;
    for (int i = 0; i < 30; i++) {
        dist_render_desc how;
        dist_hit hit;
        memset(&how, 0, sizeof how);
        how.max_distance = (float)pow(10, -i);
        for (how.any_hit = 0; how.any_hit < 2; how.any_hit++) {
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, in, ahead, &how, &hit, NULL), ctx);
            CHECK_EQUAL(DIST_RAY_INSIDE, hit.status);
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, out, ahead, &how, &hit, NULL), ctx);
            CHECK_EQUAL(i == 0 ? DIST_RAY_HIT : i == 1 ? hit.status : DIST_RAY_MISS, hit.status);
        }
    }
    dist_context_destroy(ctx);
}

TEST(any_hit_and_max_distance_are_refused_where_they_mean_nothing)
{
    dist_context *ctx = shape_context();
    float numbers[4] = {0, 0, 0, 0.5f}, depth[4];
    dist_field field = dist_field_sphere(numbers);
    dist_camera camera = shape_camera(2, 2);
    dist_images out;
    dist_render_desc how;
    memset(&out, 0, sizeof out);
    out.depth = depth;
    for (int i = 0; i < 4; i++) {
        memset(&how, 0, sizeof how);
        how.any_hit = i == 0 ? 2 : i == 1;
        how.max_distance = i == 2 ? 1.0f : i == 3 ? -1.0f : 0.0f;
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        if (i == 1) CHECK_TEXT("how.any_hit is 1, must be 0: it is for dist_trace", dist_context_message(ctx));
        if (i == 2) CHECK_TEXT("how.max_distance is 1, must be 0: it is for dist_trace", dist_context_message(ctx));
        dist_context_clear(ctx);
        CHECK_STATUS(i == 1 || i == 2 ? DIST_OK : DIST_BAD_ARGUMENT,
                     dist_trace(ctx, &field, 0, NULL, NULL, &how, NULL, NULL), ctx);
        dist_context_clear(ctx);
    }
    memset(&how, 0, sizeof how);
    how.trace = DIST_TRACE_PAPER; /* and what is for pictures, by dist_trace */
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_trace(ctx, &field, 0, NULL, NULL, &how, NULL, NULL), ctx);
    CHECK_TEXT("how.trace DIST_TRACE_PAPER is for pictures", dist_context_message(ctx));
    dist_context_clear(ctx);
    how.trace = 0, how.warm_start = 1;
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_trace(ctx, &field, 0, NULL, NULL, &how, NULL, NULL), ctx);
    CHECK_TEXT("how.warm_start is for pictures", dist_context_message(ctx));
    dist_context_destroy(ctx);
}

/* ---- nearest points ---------------------------------------------------------------------------------------------- */

static void make_points(test_random *random, int stride, float size)
{
    for (int i = 0; i < RAYS; i++)
        for (int k = 0; k < 3; k++) points[stride * i + k] = test_random_float(random, -size, size);
}

static void point_of(const float *p, double q[3])
{
    for (int k = 0; k < 3; k++) q[k] = (double)p[k];
}

TEST(closest_points_of_distances_are_exact)
{
    dist_context *ctx = shape_context();
    test_shape shapes[SHAPES];
    make_shapes(shapes);
    for (int k = 0; k < 4; k++) {
        test_random random = test_random_seed(23 + (unsigned)k);
        dist_field field = shape_field(&shapes[k], 1, 1);
        double worst = 0, residual = 0;
        make_points(&random, 3, 1.6f);
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, RAYS, points, closest, distance, status), ctx);
        for (int i = 0; i < RAYS; i++) {
            double p[3], q[3], f;
            point_of(points + 3 * i, p);
            point_of(closest + 3 * i, q);
            f = shape_value(&shapes[k], p);
            if (k == 3 && shape_length(p[0], p[1], p[2]) > 1) continue; /* asked elsewhere: some near rod */
            CHECK_EQUAL(DIST_RAY_HIT, status[i]);
            residual = fmax(residual, fabs(shape_value(&shapes[k], q)));
            worst = fmax(worst, fabs(fabs(f) - shape_length(p[0] - q[0], p[1] - q[1], p[2] - q[2])));
            worst = fmax(worst, fabs(f - (double)distance[i]));
        }
        CHECK_NEAR(0, residual, 5e-6);
        CHECK_NEAR(0, worst, 1e-4);
        if (test_state.verbose)
            printf("    residual %.2g, distance off %.2g, %.1f queries a point\n", residual, worst,
                   (double)shapes[k].queries / RAYS);
    }
    dist_context_destroy(ctx);
}

/* The distance of a box with these half axes. */
static double box_distance(const double half[3], const double p[3])
{
    double q[3], out[3];
    for (int k = 0; k < 3; k++) {
        q[k] = fabs(p[k]) - half[k];
        out[k] = fmax(q[k], 0);
    }
    return shape_length(out[0], out[1], out[2]) + fmin(fmax(q[0], fmax(q[1], q[2])), 0);
}

static double torus_distance(double ring, double tube, const double p[3])
{
    return shape_length(shape_length(p[0], p[2], 0) - ring, p[1], 0) - tube;
}

/* Points and spheres that many radii away: their nearest point is in a crease, and little nearer than others. */
TEST(what_is_far_away_finds_its_nearest_point_and_what_it_touches)
{
    dist_context *ctx = shape_context();
    const float box[6] = {0, 0, 0, 0.5f, 0.3f, 0.1f}, torus[5] = {0, 0, 0, 0.5f, 0.2f};
    const double half[3] = {(double)box[3], (double)box[4], (double)box[5]};
    const float far[] = {1.2f, 2, 4, 10, 30};
    for (int k = 0; k < 10; k++) {
        int boxed = k < 5, other = 0, lost = 0;
        dist_field field = boxed ? dist_field_box(box) : dist_field_torus(torus);
        double worst = 0, touch = 0, radius = (double)field.radius;
        test_random random = test_random_seed(71 + (unsigned)k);
        for (int i = 0; i < RAYS; i++) {
            test_random_direction(&random, points + 3 * i);
            for (int axis = 0; axis < 3; axis++) points[3 * i + axis] *= far[k % 5] * field.radius;
        }
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, RAYS, points, closest, distance, status), ctx);
        for (int i = RAYS; i-- > 0;) { /* spheres, which take the points' place from the end on */
            double p[3], f;
            point_of(points + 3 * i, p);
            f = boxed ? box_distance(half, p) : torus_distance((double)torus[3], (double)torus[4], p);
            double off = fabs(f - (double)distance[i]);
            CHECK_EQUAL(DIST_RAY_HIT, status[i]);
            other += off > 1e-3 * radius;
            if (off <= 1e-3 * radius) worst = fmax(worst, off);
            for (int axis = 0; axis < 3; axis++) points[4 * i + axis] = (float)p[axis];
            points[4 * i + 3] = (float)(f + 2e-3 * radius);
        }
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, RAYS, points, contacts), ctx);
        for (int i = 0; i < RAYS; i++) {
            if (contacts[i].status != DIST_RAY_HIT) lost++;
            else touch = fmax(touch, fabs((double)contacts[i].depth - 2e-3 * radius));
        }
        CHECK(worst <= 1e-4 * radius);
        CHECK(touch <= 1e-4 * radius);
        CHECK_EQUAL(0, other);
        CHECK_EQUAL(0, lost);
        if (test_state.verbose)
            printf("    %s, %g radii away: off %.2g radii, depth %.2g; other parts %d, contacts lost %d of %d\n",
                   boxed ? "box" : "torus", (double)far[k % 5], worst / radius, touch / radius, other, lost, RAYS);
    }
    dist_context_destroy(ctx);
}

/* A scene's own f falls outward from an instance's sphere and tells of no other instance: a torus in each of two
   orientations, a box, and a ball in a sphere twice its size, alone, together, and as a scene in the scene. */
TEST(points_find_the_nearest_instance_of_a_scene)
{
    enum { PARTS = 4 };
    dist_context *ctx = shape_context();
    const float box[6] = {0, 0, 0, 0.5f, 0.3f, 0.1f}, torus[5] = {0, 0, 0, 0.5f, 0.2f}, ball[4] = {0, 0, 0, 0.5f};
    const double half[3] = {(double)box[3], (double)box[4], (double)box[5]};
    dist_field fields[PARTS] = {dist_field_torus(torus), dist_field_torus(torus), dist_field_box(box),
                                dist_field_sphere(ball)};
    const float upright[9] = {1, 0, 0, 0, 0, 1, 0, -1, 0}, away[3] = {1, -2, 3};
    dist_instance parts[PARTS], whole;
    fields[3].radius = 1;
    memset(parts, 0, sizeof parts);
    memset(&whole, 0, sizeof whole);
    for (int k = 0; k < PARTS; k++) {
        parts[k].field = &fields[k];
        parts[k].placement.scale = k == 2 ? 2.0f : 1.0f;
        for (int i = 0; i < 3; i++) parts[k].placement.translation[i] = k == i + 1 ? 2.5f : 0.0f;
    }
    memcpy(parts[1].placement.rotation, upright, sizeof upright);
    memcpy(whole.placement.rotation, upright, sizeof upright);
    memcpy(whole.placement.translation, away, sizeof away);
    whole.placement.scale = 2;
    for (int run = 0; run < 3 * (PARTS + 1) * 2; run++) {
        int nested = run % 2, first = run / 2 % (PARTS + 1), count = 1, wrong = 0, lost = 0, told = 0;
        if (first == PARTS) first = 0, count = PARTS;
        dist_scene *inner = dist_scene_create(ctx, count, parts + first), *outer = NULL;
        dist_field field = dist_scene_field(inner), placed = field;
        if (nested) {
            whole.field = &field;
            outer = dist_scene_create(ctx, 1, &whole);
            placed = dist_scene_field(outer);
        }
        static const double least[3] = {0, 1.05, 4}, most[3] = {1, 4, 30};
        int band = run / (2 * (PARTS + 1));
        test_random random = test_random_seed(91 + (unsigned)run);
        for (int i = 0; i < RAYS; i++) {
            float share = test_random_float(&random, (float)least[band], (float)most[band]) * placed.radius;
            test_random_direction(&random, points + 3 * i);
            for (int k = 0; k < 3; k++) points[3 * i + k] = placed.center[k] + share * points[3 * i + k];
        }
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &placed, RAYS, points, closest, distance, status), ctx);
        double asked = (double)dist_scene_queries(inner) / RAYS;
        for (int i = RAYS; i-- > 0;) {
            double p[3], f = 1e30;
            point_of(points + 3 * i, p);
            if (nested) {
                for (int k = 0; k < 3; k++) p[k] = (p[k] - (double)away[k]) / 2;
                double y = p[1];
                p[1] = -p[2];
                p[2] = y;
            }
            for (int k = first; k < first + count; k++) {
                double q[3];
                for (int j = 0; j < 3; j++) q[j] = p[j] - (double)parts[k].placement.translation[j];
                if (k == 1) {
                    double y = q[1];
                    q[1] = -q[2];
                    q[2] = y;
                }
                for (int j = 0; j < 3 && k == 2; j++) q[j] /= 2;
                f = fmin(f, k < 2    ? torus_distance((double)torus[3], (double)torus[4], q)
                            : k == 2 ? 2 * box_distance(half, q)
                                     : shape_length(q[0], q[1], q[2]) - (double)ball[3]);
            }
            if (nested) f *= 2;
            lost += status[i] != DIST_RAY_HIT;
            wrong += status[i] == DIST_RAY_HIT &&
                     fabs(f - (double)distance[i]) > (band == 0 ? 1e-4 : 1e-3) * (double)placed.radius;
            for (int k = 3; k-- > 0;) points[4 * i + k] = points[3 * i + k];
            points[4 * i + 3] = (float)(fmax(f, 0) + 0.02 * (double)placed.radius);
        }
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &placed, RAYS, points, contacts), ctx);
        for (int i = 0; i < RAYS; i++) told += contacts[i].status != DIST_RAY_HIT;
        CHECK_EQUAL(0, lost);
        CHECK(wrong <= (band == 0 ? 0 : 3));
        CHECK(told <= (band == 0 ? 0 : 3));
        CHECK(band > 0 || asked <= 50.0);
        if (test_state.verbose)
            printf("    %d of %d from part %d, %g to %g radii away%s: %d not found, %d wrong, %d told clear of %d; "
                   "%.1f queries a point\n", count, PARTS, first, least[band], most[band],
                   nested ? ", in a scene" : "", lost, wrong, told, RAYS, asked);
        dist_scene_destroy(outer);
        dist_scene_destroy(inner);
    }
    dist_context_destroy(ctx);
}

/* Two balls that overlap, of radius r at -+h on the x axis. What is of one in the other is no surface: from inside the
   nearest point is of a ball outside of the other, or of the circle where they meet. */
static double two_balls_distance(double h, double r, const double p[3])
{
    double around = shape_length(p[1], p[2], 0), ring = sqrt(r * r - h * h);
    double least = shape_length(p[0], around - ring, 0), within = 1e30;
    for (int side = -1; side < 2; side += 2) {
        double x = p[0] - side * h, length = shape_length(x, around, 0);
        within = fmin(within, length - r);
        if ((x / length * r + side * h) * side >= 0) least = fmin(least, fabs(length - r));
    }
    return within < 0 ? -least : least;
}

TEST(what_is_of_one_instance_in_another_is_no_surface)
{
    dist_context *ctx = shape_context();
    const float ball[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(ball);
    dist_instance two[2];
    memset(two, 0, sizeof two);
    two[0].field = two[1].field = &field;
    two[0].placement.translation[0] = -0.3f;
    two[1].placement.translation[0] = 0.3f;
    dist_scene *scene = dist_scene_create(ctx, 2, two);
    dist_field both = dist_scene_field(scene);
    test_random random = test_random_seed(97);
    int wrong = 0, inside = 0, overlap = 0;
    double residual = 0, worst = 0;
    make_points(&random, 3, 0.8f);
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &both, RAYS, points, closest, distance, status), ctx);
    for (int i = 0; i < RAYS; i++) {
        double p[3], q[3], f;
        point_of(points + 3 * i, p);
        point_of(closest + 3 * i, q);
        f = two_balls_distance(0.3, 0.5, p);
        CHECK_EQUAL(DIST_RAY_HIT, status[i]);
        double left = shape_length(q[0] + 0.3, q[1], q[2]), right = shape_length(q[0] - 0.3, q[1], q[2]);
        residual = fmax(residual, fabs(fmin(left, right) - 0.5));
        inside += f < 0;
        overlap += fmax(shape_length(p[0] - 0.3, p[1], p[2]), shape_length(p[0] + 0.3, p[1], p[2])) < 0.5;
        if (f > 0) worst = fmax(worst, fabs(f - (double)distance[i]));
        CHECK((f < 0) == (distance[i] < 0) || fabs(f) < 1e-5);
        wrong += fabs(f - (double)distance[i]) > 1e-3;
    }
    CHECK(inside > 300 && overlap > 60);
    CHECK_NEAR(0, residual, 1e-4);
    CHECK_NEAR(0, worst, 1e-4);
    CHECK(wrong * 20 <= inside);
    if (test_state.verbose)
        printf("    residual %.2g, outside off by %.2g; %d inside, %d in both, %d another part\n", residual, worst,
               inside, overlap, wrong);
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

/* Where a field stands far from the origin the rounding of points changes f: what is exact then, and the bounds. */
TEST(fields_far_from_the_origin_are_found_to_within_what_floats_can_tell)
{
    dist_context *ctx = shape_context();
    const float at[] = {0, 10, 100, 1000};
    for (int k = 0; k < 8; k++) {
        float x = at[k / 2], numbers[4] = {0, 0, 0, 0.5f};
        int beyond = 0, hits = 0;
        double worst = 0, c = (double)x;
        dist_field field;
        dist_render_desc how;
        dist_stats stats;
        test_random random = test_random_seed(91 + (unsigned)k);
        memset(&how, 0, sizeof how);
        how.certified = k & 1;
        numbers[0] = x;
        field = dist_field_sphere(numbers);
        for (int i = 0; i < RAYS; i++) {
            for (int axis = 0; axis < 3; axis++) {
                float toward = test_random_float(&random, -0.3f, 0.3f);
                origins[3 * i + axis] = test_random_float(&random, -3, 3);
                points[3 * i + axis] = test_random_float(&random, -1, 1);
                if (axis == 0) {
                    origins[3 * i] += x;
                    points[3 * i] += x;
                    toward += x;
                }
                directions[3 * i + axis] = toward - origins[3 * i + axis];
            }
        }
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, RAYS, origins, directions, &how, nearest, &stats), ctx);
        for (int i = 0; i < RAYS; i++) {
            double o[3], d[3], along = 0, square = -0.25, length;
            point_of(origins + 3 * i, o);
            point_of(directions + 3 * i, d);
            o[0] -= c;
            length = shape_length(d[0], d[1], d[2]);
            for (int axis = 0; axis < 3; axis++) {
                along -= o[axis] * d[axis] / length;
                square += o[axis] * o[axis];
            }
            if (!(square > 1e-3) || !blocked(&nearest[i]) || along * along < square) continue;
            hits++;
            double off = fabs((double)nearest[i].distance - (along - sqrt(along * along - square)));
            beyond += off > (double)nearest[i].error;
        }
        CHECK(hits > RAYS / 2);
        CHECK_EQUAL(0, beyond);
        CHECK_EQUAL(0, (int)(stats.steepest * 1e6f));
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, RAYS, points, closest, distance, status), ctx);
        for (int i = 0; i < RAYS; i++) {
            double p[3];
            point_of(points + 3 * i, p);
            CHECK_EQUAL(DIST_RAY_HIT, status[i]);
            worst = fmax(worst, fabs(shape_length(p[0] - c, p[1], p[2]) - 0.5 - (double)distance[i]));
        }
        CHECK_NEAR(0, worst, 2e-6 + 3e-7 * c);
        if (test_state.verbose)
            printf("    %g off: %d hits, %d beyond their bounds; distances off %.2g\n", c, hits, beyond, worst);
    }
    dist_context_destroy(ctx);
}

enum { SURFACE = 2 * RAYS };
static float surface[3 * SURFACE];

/* Points of the surface: as many as the array has room for, or as 8 (quick: 1) times RAYS rays hit. */
static int surface_sample(const dist_field *field, dist_context *ctx)
{
    test_random random = test_random_seed(5);
    int count = 0;
    int rounds = test_quick() ? 1 : 8;
    for (int round = 0; round < rounds && count + RAYS <= SURFACE; round++) {
        for (int i = 0; i < RAYS; i++) {
            float u[3], to[3];
            test_random_direction(&random, u);
            test_random_direction(&random, to);
            for (int k = 0; k < 3; k++) {
                origins[3 * i + k] = field->center[k] + 2 * field->radius * u[k];
                directions[3 * i + k] = field->center[k] + 0.8f * field->radius * to[k] - origins[3 * i + k];
            }
        }
        dist_trace(ctx, field, RAYS, origins, directions, NULL, nearest, NULL);
        for (int i = 0; i < RAYS; i++) {
            float length = length_of(directions + 3 * i);
            if (!blocked(&nearest[i])) continue;
            for (int k = 0; k < 3; k++)
                surface[3 * count + k] = origins[3 * i + k] + nearest[i].distance / length * directions[3 * i + k];
            count++;
        }
    }
    return count;
}

/* How far off the nearest surface sample is. */
static double nearest_of(int count, const float *p)
{
    double best = 1e30;
    for (int j = 0; j < count; j++) {
        double d = 0;
        for (int k = 0; k < 3; k++) {
            double x = (double)p[k] - (double)surface[3 * j + k];
            d += x * x;
        }
        best = fmin(best, d);
    }
    return sqrt(best);
}

/* Share of the points for which a surface sample is nearer than what was found by more than `slack`. */
static double beaten(int count, double slack)
{
    int n = 0;
    for (int i = 0; i < RAYS; i++) n += nearest_of(count, points + 3 * i) < fabs((double)distance[i]) - slack;
    return (double)n / RAYS;
}

TEST(closest_points_of_other_fields_are_on_the_surface_and_near)
{
    dist_context *ctx = shape_context();
    for (int k = 0; k < 5; k++) {
        test_random random = test_random_seed(33 + (unsigned)k);
        test_shape shape = k == 0   ? shape_make(SHAPE_BUMPY, 0.7, 0.05, 8, 0)
                           : k == 4 ? shape_make(SHAPE_BOX, 0.4, 0.5, 0.3, 0)
                                    : shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
        if (k == 1) shape.slope = 0.5;
        if (k == 2) shape.clamp = 0.1;
        if (k == 3) shape.slope = 2;
        if (k == 4) shape.squash = 6;
        dist_field field = shape_field(&shape, 1, k == 3 ? 2 : k == 4 ? 6 : 1.4);
        int lost = 0;
        double residual = 0;
        make_points(&random, 3, 1.4f);
        for (int i = 0; i < RAYS && k == 2; i++) { /* where the clamp leaves a distance to go by */
            double p[3];
            do {
                for (int axis = 0; axis < 3; axis++) points[3 * i + axis] = test_random_float(&random, -1, 1);
                point_of(points + 3 * i, p);
            } while (fabs(shape_exact(&shape, p)) > 0.099);
        }
        long before = shape.queries;
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, RAYS, points, closest, distance, status), ctx);
        double queries = (double)(shape.queries - before) / RAYS;
        for (int i = 0; i < RAYS; i++) {
            double q[3], p[3];
            point_of(closest + 3 * i, q);
            point_of(points + 3 * i, p);
            lost += status[i] != DIST_RAY_HIT;
            if (status[i] != DIST_RAY_HIT) continue;
            residual = fmax(residual, fabs(shape_value(&shape, q)));
            CHECK(shape_value(&shape, p) * (double)distance[i] >= 0);
            CHECK_NEAR(shape_length(p[0] - q[0], p[1] - q[1], p[2] - q[2]), fabs((double)distance[i]), 1e-5);
        }
        int count = surface_sample(&field, ctx);
        double share = beaten(count, 0.01);
        CHECK(count > RAYS / 10);
        CHECK(lost <= RAYS / 500);
        CHECK_NEAR(0, residual, 2e-5);
        CHECK(share < 0.05); /* two nearest points, and the wrong one found */
        if (test_state.verbose)
            printf("    %d lost, residual %.2g, %.2f %% beaten, %.1f queries a point\n", lost, residual, 100 * share,
                   queries);
    }
    dist_context_destroy(ctx);
}

TEST(closest_points_of_networks_lie_on_their_surface)
{
    static const model_desc descs[2] = {
        {.name = "relu", .code_size = 2, .width = 16, .clamp = 0.3},
        {.name = "softplus", .code_size = 2, .activation = DIST_ACTIVATION_SOFTPLUS, .first_scale = 4.0}};
    static float sdf[RAYS];
    dist_context *ctx = test_context();
    for (int k = 0; k < 4; k++) { /* the mug: nearly 0 over a region within, without a crossing */
        test_random random = test_random_seed(43 + (unsigned)k);
        double code[MODEL_CODE] = {0.25, 0.25};
        float codef[2] = {0.25f, 0.25f};
        model m;
        dist_net *net;
        int n = RAYS;
        if (k >= 2) {
            const char *path = test_data_path(k == 2 ? "nets/fox.safetensors" : "nets/mug_camera_bottle.safetensors");
            FILE *file = fopen(path, "rb");
            if (!file) SKIP("there are no test data");
            fclose(file);
            net = dist_net_load_file(ctx, path);
            n = 300;
        } else {
            m = model_make(&descs[k], 7);
            model_fit_ball(&m, code, 0.6);
            net = model_load(ctx, &m);
        }
        dist_shape *shape = dist_shape_create(ctx, net, k >= 2 ? dist_net_code(net, 0) : codef);
        dist_field field = dist_shape_field(shape);
        double residual = 0;
        int lost = 0;
        make_points(&random, 3, 1.3f);
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, (size_t)n, points, closest, distance, status), ctx);
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, (size_t)n, closest, sdf, NULL), ctx);
        for (int i = 0; i < n; i++) {
            lost += status[i] != DIST_RAY_HIT;
            if (status[i] == DIST_RAY_HIT) residual = fmax(residual, fabs((double)sdf[i]));
        }
        CHECK_NEAR(0, residual, 2e-5);
        CHECK(lost <= n / 200); /* where f has a least value above 0 */
        if (test_state.verbose) printf("    %d of %d lost, residual %.2g\n", lost, n, residual);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        if (k < 2) model_free(&m);
    }
    dist_context_destroy(ctx);
}

static unsigned long long asked;

static void counted_eval(void *user, int worker, size_t n, const float *at, float *sdf, float *gradient)
{
    const dist_field *field = (const dist_field *)user;
    asked += n;
    field->eval_fn(field->user, worker, n, at, sdf, gradient);
}

/* Far from the surface a decoder's f is no distance, and its gradient leads to other parts: against the nearest of what
   rays hit, and spheres that are in by a 50th. */
TEST(what_decoders_say_far_off_leads_to_the_nearest_part_all_the_same)
{
    static const struct {
        const char *name;
        int code;
    } nets[] = {{NULL, 37}, {NULL, 111}, {"fox", 0}, {"bob_spot", 1}, {"primitives", 3}, {"chairs", 1},
                {"mug_camera_bottle", 1}};
    const float away[2] = {1.5f, 4};
    dist_context *ctx = test_context();
    int absent = 0;
    for (int k = 0; k < (test_quick() ? 3 : (int)(sizeof nets / sizeof *nets)); k++) {
        char path[64];
        (void)snprintf(path, sizeof path, "nets/%s.safetensors", nets[k].name ? nets[k].name : "");
        FILE *file = nets[k].name ? fopen(test_data_path(path), "rb") : NULL;
        absent += nets[k].name && !file;
        if (nets[k].name && !file) continue;
        if (file) fclose(file);
        dist_net *net = dist_net_load_file(ctx, file ? test_data_path(path) : "examples/model.safetensors");
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, nets[k].code));
        dist_field field = dist_shape_field(shape), counted = field;
        enum { POINTS = 400 };
        counted.user = &field;
        counted.eval_fn = counted_eval;
        int count = surface_sample(&field, ctx);
        int thin = k == 6; /* walls thinner than a cell, and f nearly 0 between them */
        CHECK(count > RAYS / 20);
        for (int band = 0; band < 2; band++) {
            test_random random = test_random_seed(131 + (unsigned)(2 * k + band));
            int off = 0, past = 0, lost = 0, told = 0;
            double worst = 0;
            for (int i = 0; i < POINTS; i++) {
                test_random_direction(&random, points + 3 * i);
                for (int axis = 0; axis < 3; axis++)
                    points[3 * i + axis] = field.center[axis] + away[band] * field.radius * points[3 * i + axis];
            }
            asked = 0;
            dist_field_closest_point(ctx, &counted, POINTS, points, closest, distance, status);
            double queries = (double)asked / POINTS, alone;
            asked = 0;
            for (int i = 0; i < 10; i++) { /* what other points ask for serves a point, and changes no more than the
                                              rounding of lone gradients does */
                float x[3], d;
                dist_field_closest_point(ctx, &counted, 1, points + 3 * i, x, &d, NULL);
                CHECK(fabsf(d - distance[i]) <= 1e-3f * field.radius);
            }
            alone = (double)asked / 10;
            for (int i = POINTS; i-- > 0;) { /* spheres, which take the points' place from the end on */
                double best = nearest_of(count, points + 3 * i), more = fabs((double)distance[i]) - best;
                lost += status[i] != DIST_RAY_HIT;
                off += more > 0.01 * (double)field.radius;
                past += more > 0.002 * (double)field.radius;
                worst = fmax(worst, more);
                for (int axis = 3; axis-- > 0;) points[4 * i + axis] = points[3 * i + axis];
                points[4 * i + 3] = (float)best + 0.02f * field.radius;
            }
            CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, POINTS, points, contacts), ctx);
            for (int i = 0; i < POINTS; i++) told += contacts[i].status != DIST_RAY_HIT;
            CHECK_EQUAL(0, lost);
            CHECK(past <= (thin ? 2 * POINTS / 5 : POINTS / 20));
            CHECK(off <= (thin ? POINTS / 14 : 2)); /* two parts in one cell may be taken for one */
            CHECK(told <= (thin ? POINTS / 80 : 1));
            CHECK(worst < (thin ? 0.05 : 0.02) * (double)field.radius);
            CHECK(queries < 180);
            if (test_state.verbose)
                printf("    %s %d, %g radii away: %d off by more than a 100th, %d a 500th, worst %.3f, %d not found, "
                       "%d spheres told clear, of %d; %.1f queries a point, %.1f alone\n",
                       nets[k].name ? nets[k].name : "embedded", nets[k].code, (double)away[band], off, past, worst,
                       lost, told, POINTS, queries, alone);
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    dist_context_destroy(ctx);
    if (absent) SKIP("there are no test data; the embedded model passes");
}

/* A torus that is hollow: 0 inside, and flat. */
static void flat_eval(void *user, int worker, size_t n, const float *at, float *sdf, float *gradient)
{
    const dist_field *field = (const dist_field *)user;
    asked += !test_finite_all(3 * n, at);
    field->eval_fn(field->user, worker, n, at, sdf, gradient);
    for (size_t i = 0; i < n; i++) {
        if (sdf[i] > 0) continue;
        sdf[i] = 0;
        for (size_t k = 0; gradient && k < 3; k++) gradient[3 * i + k] = 0;
    }
}

TEST(closest_points_of_fields_without_an_inside_are_found)
{
    dist_context *ctx = shape_context();
    const float torus[5] = {0, 0, 0, 0.55f, 0.2f};
    dist_field field = dist_field_torus(torus), flat = field;
    test_random random = test_random_seed(3);
    flat.user = &field;
    flat.eval_fn = flat_eval;
    asked = 0;
    for (int k = 0; k < 4; k++) {
        flat.lipschitz = (float)(1 + k % 2);
        make_points(&random, 3, k < 2 ? 1.0f : 3.0f);
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &flat, RAYS, points, closest, distance, status), ctx);
        for (int i = 0; i < RAYS; i++) CHECK_EQUAL(DIST_RAY_HIT, status[i]);
        make_points(&random, 4, k < 2 ? 1.0f : 3.0f);
        for (int i = 0; i < RAYS; i++) points[4 * i + 3] = 0.1f;
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &flat, RAYS, points, contacts), ctx);
        for (int i = 0; i < RAYS; i++) CHECK(contacts[i].status == DIST_RAY_HIT || contacts[i].status == DIST_RAY_MISS);
    }
    CHECK_EQUAL(0, asked); /* nothing where a point is not finite */
    dist_context_destroy(ctx);
}

TEST(a_sphere_without_a_radius_is_a_point)
{
    dist_context *ctx = shape_context();
    const float ball[4] = {0, 0, 0, 0.5f}, far[4] = {3, 0, 0, 0.5f}, at[8] = {0.1f, 0, 0, 0, 0.7f, 0, 0, 0};
    dist_field field[3] = {dist_field_sphere(ball), dist_field_sphere(far)};
    dist_instance instances[2];
    memset(instances, 0, sizeof instances);
    for (int k = 0; k < 2; k++) instances[k].field = &field[k];
    for (int count = 0; count < 3; count++) { /* by itself, then in scenes */
        dist_scene *scene = count > 0 ? dist_scene_create(ctx, count, instances) : NULL;
        field[2] = scene ? dist_scene_field(scene) : field[0];
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field[2], 2, at, contacts), ctx);
        CHECK_EQUAL(DIST_RAY_HIT, contacts[0].status);
        CHECK_NEAR(0.4, contacts[0].depth, 1e-5);
        CHECK_EQUAL(DIST_RAY_MISS, contacts[1].status);
        CHECK(contacts[1].depth <= -0.1f && contacts[1].depth >= -0.2f - 1e-5f);
        dist_scene_destroy(scene);
    }
    dist_context_destroy(ctx);
}

typedef struct bubbles {
    int n;
    float sphere[6][4];
} bubbles;

/* The distance to the nearest of some spheres. */
static void bubbles_eval(void *user, int worker, size_t n, const float *at, float *sdf, float *gradient)
{
    const bubbles *b = (const bubbles *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        sdf[i] = 3e38f;
        for (int k = 0; k < b->n; k++) {
            const float *c = b->sphere[k];
            float d[3] = {at[3 * i] - c[0], at[3 * i + 1] - c[1], at[3 * i + 2] - c[2]};
            float length = sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
            if (!(length - c[3] < sdf[i])) continue;
            sdf[i] = length - c[3];
            for (int j = 0; gradient && j < 3; j++) gradient[3 * i + (size_t)j] = d[j] / length;
        }
    }
}

/* From outside of the bounding sphere: where a look around finds a farther one's seed first, the nearer one's counts
   by where a slide from its seed may lead. */
TEST(the_nearest_of_small_parts_is_found_from_far_away)
{
    enum { SCENES = 100, POINTS = 100 };
    dist_context *ctx = shape_context();
    test_random random = test_random_seed(61);
    int off = 0;
    double worst = 0.0;
    for (int scene = 0; scene < SCENES; scene++) {
        bubbles b = {2 + scene % 5, {{0}}};
        float at[3 * POINTS], found[3 * POINTS], way[POINTS], value[POINTS];
        for (int k = 0; k < b.n; k++) {
            test_random_fill(&random, 3, b.sphere[k], -0.4f, 0.4f);
            b.sphere[k][3] = test_random_float(&random, 0.02f, 0.2f);
        }
        dist_field field;
        memset(&field, 0, sizeof field);
        field.user = &b;
        field.eval_fn = bubbles_eval;
        field.radius = 1.0f;
        for (int i = 0; i < POINTS; i++) {
            float *p = at + 3 * i, length = 0.0f;
            while (!(length > 0.1f)) {
                test_random_fill(&random, 3, p, -1.0f, 1.0f);
                length = sqrtf(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
            }
            for (int j = 0; j < 3; j++) p[j] *= 3.0f / length;
        }
        bubbles_eval(&b, 0, POINTS, at, value, NULL);
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, POINTS, at, found, way, NULL), ctx);
        for (int i = 0; i < POINTS; i++) {
            worst = fmax(worst, (double)(way[i] - value[i]));
            off += way[i] - value[i] > 1.1e-4f;
        }
    }
    if (test_state.verbose) printf("    %d of %d are off, by up to %.2g\n", off, SCENES * POINTS, worst);
    CHECK(off <= SCENES * POINTS / 500);
    CHECK(worst < 0.02);
    dist_context_destroy(ctx);
}

/* By the plane that touches the surface, not by ever smaller shares of the way. */
TEST(closest_points_of_smooth_surfaces_take_a_few_queries)
{
    static const model_desc descs[2] = {
        {.name = "softplus", .code_size = 2, .activation = DIST_ACTIVATION_SOFTPLUS, .first_scale = 4.0},
        {.name = "relu", .code_size = 2, .width = 16, .clamp = 0.3}};
    static const double most[3] = {11, 20, 55}; /* the cells of a look around among them */
    dist_context *ctx = shape_context();
    for (int k = 0; k < 3; k++) {
        const float torus[5] = {0, 0, 0, 0.55f, 0.2f};
        double code[MODEL_CODE] = {0.25, 0.25};
        float codef[2] = {0.25f, 0.25f};
        test_random random = test_random_seed(47 + (unsigned)k);
        dist_field field = dist_field_torus(torus);
        dist_net *net = NULL;
        dist_shape *shape = NULL;
        model m;
        if (k > 0) {
            m = model_make(&descs[k - 1], 7);
            model_fit_ball(&m, code, 0.6);
            net = model_load(ctx, &m);
            shape = dist_shape_create(ctx, net, codef);
            field = dist_shape_field(shape);
        }
        dist_field counted = field;
        counted.user = &field;
        counted.eval_fn = counted_eval;
        asked = 0;
        make_points(&random, 3, 1.0f);
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &counted, RAYS, points, closest, distance, status), ctx);
        if (test_state.verbose) printf("    %.2f queries a point\n", (double)asked / RAYS);
        CHECK((double)asked < most[k] * RAYS);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        if (k > 0) model_free(&m);
    }
    dist_context_destroy(ctx);
}

/* Two balls, of which f at the one is a third of the distance: the gradient leads to it past the other. */
static void slow_and_fast_eval(void *user, int worker, size_t n, const float *at, float *sdf, float *gradient)
{
    (void)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        double p[3];
        point_of(at + 3 * i, p);
        double a = shape_length(p[0] + 0.4, p[1], p[2]), b = shape_length(p[0] - 0.4, p[1], p[2]);
        int slow = (a - 0.3) / 3 < b - 0.2;
        double scale = slow ? 1 / (3 * fmax(a, 1e-9)) : 1 / fmax(b, 1e-9);
        sdf[i] = (float)(slow ? (a - 0.3) / 3 : b - 0.2);
        for (size_t k = 0; gradient && k < 3; k++)
            gradient[3 * i + k] = (float)(scale * (p[k] + (k > 0 ? 0.0 : slow ? 0.4 : -0.4)));
    }
}

TEST(a_nearer_part_of_the_surface_is_found_by_looking_around)
{
    dist_context *ctx = test_context();
    test_random random = test_random_seed(51);
    dist_field field;
    memset(&field, 0, sizeof field);
    field.eval_fn = slow_and_fast_eval;
    field.radius = field.lipschitz = 1;
    make_points(&random, 3, 0.9f);
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, RAYS, points, closest, distance, status), ctx);
    int led = 0, past = 0;
    for (int i = 0; i < RAYS; i++) {
        double p[3];
        point_of(points + 3 * i, p);
        double a = shape_length(p[0] + 0.4, p[1], p[2]) - 0.3, b = shape_length(p[0] - 0.4, p[1], p[2]) - 0.2;
        CHECK_EQUAL(DIST_RAY_HIT, status[i]);
        led += b > 0 && b < a && a / 3 < b;
        past += fabs((double)distance[i]) > fmin(fabs(a), fabs(b)) + 1e-3;
    }
    CHECK(led > RAYS / 5 && past < led / 50); /* without all that are led past end there */
    if (test_state.verbose) printf("    %d are led past the nearer ball, %d end at the other\n", led, past);
    dist_context_destroy(ctx);
}

/* Boards thinner than a step of Newton: the walk goes to and fro in them until it bisects. */
TEST(closest_points_of_thin_boards_are_found)
{
    static float sdf[RAYS];
    dist_context *ctx = test_context();
    dist_net *net = dist_net_load_file(ctx, "examples/model.safetensors");
    test_random random = test_random_seed(47);
    for (int k = 0; k < 256; k += 37) {
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, k));
        dist_field field = dist_shape_field(shape);
        const size_t n = RAYS < 100 ? RAYS : 100;
        make_points(&random, 3, 1.3f);
        points[0] = points[2] = 0.0f, points[1] = 2.0f;
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, n, points, closest, distance, status), ctx);
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, n, closest, sdf, NULL), ctx);
        for (size_t i = 0; i < n; i++) {
            CHECK_EQUAL(DIST_RAY_HIT, status[i]);
            CHECK_NEAR(0, sdf[i], 1e-5);
        }
        dist_shape_destroy(shape);
    }
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* ---- contacts ---------------------------------------------------------------------------------------------------- */

TEST(contacts_have_the_depth_and_the_normal_of_the_shape)
{
    dist_context *ctx = shape_context();
    test_shape shapes[SHAPES];
    make_shapes(shapes);
    for (int k = 0; k < 4; k++) {
        test_random random = test_random_seed(53 + (unsigned)k);
        dist_field field = shape_field(&shapes[k], 1, 1);
        int touching = 0, wrong = 0, still = 0;
        double worst = 0;
        make_points(&random, 4, 1.5f);
        for (int i = 0; i < RAYS; i++) points[4 * i + 3] = test_random_float(&random, 0.05f, 0.4f);
        shapes[k].queries = 0;
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, RAYS, points, contacts), ctx);
        for (int i = 0; i < RAYS; i++) {
            const dist_contact *c = &contacts[i];
            double p[3], f, r = (double)points[4 * i + 3];
            point_of(points + 4 * i, p);
            f = shape_value(&shapes[k], p);
            if (fabs(r - f) < 1e-4) continue;
            wrong += (f < r) != (c->status == DIST_RAY_HIT);
            if (c->status != DIST_RAY_HIT) {
                wrong += (double)c->depth < r - f - 1e-5 || c->depth > 0; /* no farther apart than it says */
                continue;
            }
            touching++;
            worst = fmax(worst, fabs((double)c->depth - (r - f)));
            double out[3];
            for (int axis = 0; axis < 3; axis++) out[axis] = p[axis] + 1.0001 * (double)(c->depth * c->normal[axis]);
            still += shape_value(&shapes[k], out) < r - 2e-3;
        }
        CHECK(touching > RAYS / 20);
        CHECK_EQUAL(0, wrong);
        CHECK_NEAR(0, worst, 1e-4);
        CHECK(k == 3 || still == 0); /* out of one rod may be into another */
        if (test_state.verbose)
            printf("    %d touch, depth off %.2g, %d still do, %.2f queries a sphere\n", touching, worst, still,
                   (double)shapes[k].queries / RAYS);
    }
    dist_context_destroy(ctx);
}

TEST(spheres_that_are_clear_cost_one_query_or_none)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    float spheres[12] = {0.8f, 0, 0, 0.1f, 1.05f, 0, 0, 0.1f, 5, 0, 0, 1};
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 3, spheres, contacts), ctx);
    CHECK_EQUAL(2, shape.queries);
    for (int i = 0; i < 3; i++) CHECK_EQUAL(DIST_RAY_MISS, contacts[i].status);
    CHECK_NEAR(-0.2, contacts[0].depth, 1e-6);
    CHECK_NEAR(-3, contacts[2].depth, 1e-6);
    dist_context_destroy(ctx);
}

/* f is a third of the distance: what lies beyond a 16th of the radius off the sphere was not looked at. */
TEST(spheres_are_no_farther_off_than_was_looked)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.5, 0, 0, 0);
    shape.slope = 0.3;
    dist_field field = shape_field(&shape, 1, 1);
    float spheres[8] = {0.8f, 0, 0, 0.1f, 0, 0.63f, 0, 0.1f};
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 2, spheres, contacts), ctx);
    for (int i = 0; i < 2; i++) CHECK_EQUAL(DIST_RAY_MISS, contacts[i].status);
    CHECK_NEAR(-1.0 / 16, contacts[0].depth, 1e-6); /* -0.2 */
    CHECK_NEAR(-0.03, contacts[1].depth, 1e-5);
    dist_context_destroy(ctx);
}

/* Spheres that are told to be clear of what a nearest point lies in them; touching: how many one lies in. */
static int touching_missed(dist_context *ctx, const dist_field *field, int *touching)
{
    static float spheres[4 * RAYS];
    test_random random = test_random_seed(71);
    int missed = *touching = 0;
    make_points(&random, 3, 0.8f);
    for (int i = 0; i < RAYS; i++) {
        memcpy(spheres + 4 * i, points + 3 * i, 3 * sizeof(float));
        spheres[4 * i + 3] = test_random_float(&random, 0.01f, 0.1f);
    }
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, field, RAYS, points, closest, distance, status), ctx);
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, field, RAYS, spheres, contacts), ctx);
    for (int i = 0; i < RAYS; i++) {
        int touches = status[i] == DIST_RAY_HIT && distance[i] < 0.999f * spheres[4 * i + 3];
        *touching += touches;
        missed += touches && contacts[i].status != DIST_RAY_HIT;
        if (distance[i] < 0) CHECK_NEAR(spheres[4 * i + 3] - distance[i], contacts[i].depth, 2e-6);
    }
    return missed;
}

/* By the slope of most places a steep place's sphere of |f| / slope reaches into the surface. */
TEST(no_sphere_that_touches_a_steep_field_is_told_to_be_clear)
{
    static const char *const nets[] = {"rings", "round_cross", "bunny_relu"};
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.2, 0, 0);
    shape.slope = 2;
    dist_field steep = shape_field(&shape, 1, 1);
    int touching;
    CHECK(touching_missed(ctx, &steep, &touching) > 0);
    steep.certified = 2;
    CHECK_EQUAL(0, touching_missed(ctx, &steep, &touching));
    CHECK(touching > 100);
    for (int k = 0; k < 3; k++) {
        char path[64];
        (void)snprintf(path, sizeof path, "nets/%s.safetensors", nets[k]);
        FILE *file = fopen(test_data_path(path), "rb");
        if (!file) dist_context_destroy(ctx);
        if (!file) SKIP("there are no test data");
        fclose(file);
        dist_net *net = dist_net_load_file(ctx, test_data_path(path));
        dist_shape *shape_of = dist_shape_create(ctx, net, net ? dist_net_code(net, k == 1 ? 10 : 0) : NULL);
        dist_field field = dist_shape_field(shape_of), most = field;
        CHECK(500 * touching_missed(ctx, &field, &touching) <= touching); /* a search may end at another part */
        most.certified = most.certified_far = 0;
        int missed = touching_missed(ctx, &most, &touching);
        CHECK(touching > 100 && (missed > 0 || k > 0));
        if (test_state.verbose) printf("    %s: %d touch, by most slopes %d missed\n", nets[k], touching, missed);
        dist_shape_destroy(shape_of);
        dist_net_destroy(net);
    }
    dist_context_destroy(ctx);
}

TEST(spheres_touch_the_instance_that_is_there)
{
    dist_context *ctx = test_context();
    float ball[4] = {0, 0, 0, 0.5f}, box[6] = {0, 0, 0, 0.5f, 0.5f, 0.5f};
    dist_field fields[2] = {dist_field_sphere(ball), dist_field_box(box)};
    dist_instance two[2];
    memset(two, 0, sizeof two);
    two[0].field = &fields[0];
    two[1].field = &fields[1];
    two[1].placement.translation[0] = 3;
    two[1].placement.scale = 2;
    dist_scene *scene = dist_scene_create(ctx, 2, two);
    dist_field field = dist_scene_field(scene);
    float spheres[12] = {0, 0.6f, 0, 0.2f, 3, 0, 1.1f, 0.3f, 1.2f, 0, 0, 0.1f};
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 3, spheres, contacts), ctx);
    CHECK_EQUAL(DIST_RAY_HIT, contacts[0].status);
    CHECK_NEAR(0.1, contacts[0].depth, 1e-5);
    CHECK_NEAR(1, contacts[0].normal[1], 1e-5);
    CHECK_EQUAL(DIST_RAY_HIT, contacts[1].status);
    CHECK_NEAR(0.2, contacts[1].depth, 1e-5);
    CHECK_NEAR(1, contacts[1].normal[2], 1e-5);
    CHECK_NEAR(1, contacts[1].point[2], 1e-5);
    CHECK_EQUAL(DIST_RAY_MISS, contacts[2].status);
    unsigned long long queries = dist_scene_queries(scene);
    float between[4] = {0.9f, 0.9f, 0, 0.1f}; /* clear of both bounding spheres */
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 1, between, contacts), ctx);
    CHECK_EQUAL(DIST_RAY_MISS, contacts[0].status);
    CHECK(contacts[0].depth < -0.2f);
    CHECK_EQUAL(queries, dist_scene_queries(scene));
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

TEST(what_has_no_answer_says_so)
{
    dist_context *ctx = shape_context();
    test_shape shapes[3] = {shape_make(SHAPE_CONSTANT, 0.1, 0, 0, 0), shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0),
                            shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0)};
    float p[12] = {0.1f, 0.2f, 0.3f, 0.1f, 0, 0, 0.5f, 0.1f, 0, 0, 0, 0.1f};
    shapes[1].poison = 0.4;
    dist_field field = shape_field(&shapes[0], 1, 1);
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, 1, p, closest, distance, status), ctx);
    CHECK_EQUAL(DIST_RAY_UNRESOLVED, status[0]);
    CHECK(test_finite_all(3, closest));
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, 1, p, closest, NULL, NULL), ctx);
    field = shape_field(&shapes[1], 1, 1);
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, 1, p + 4, closest, distance, status), ctx);
    CHECK_EQUAL(DIST_RAY_NOT_FINITE, status[0]);
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 1, p + 4, contacts), ctx);
    CHECK_EQUAL(DIST_RAY_NOT_FINITE, contacts[0].status);
    field = shape_field(&shapes[2], 1, 1); /* from the very center every way is as good */
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, 1, p + 8, closest, distance, status), ctx);
    CHECK_EQUAL(DIST_RAY_HIT, status[0]);
    CHECK_NEAR(-0.6, distance[0], 1e-5);
    uint32_t nan = 0x7fc00000u, infinity = 0x7f800000u;
    float bad[8] = {0, 0, 0, 0, 0, 0, 0, 1};
    memcpy(bad + 1, &nan, sizeof nan);
    memcpy(bad + 6, &infinity, sizeof infinity);
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 2, bad, contacts), ctx);
    CHECK_EQUAL(DIST_RAY_NOT_FINITE, contacts[0].status);
    CHECK_EQUAL(DIST_RAY_NOT_FINITE, contacts[1].status);
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 0, NULL, NULL), ctx);
    float negative[8] = {0, 0, 0, 1, 0, 0, 0, -1};
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_collide(ctx, &field, 2, negative, contacts), ctx);
    CHECK_TEXT("radius of sphere 1 is -1", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_collide(ctx, &field, 1, NULL, contacts), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_collide(ctx, NULL, 1, p, contacts), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_collide(NULL, &field, 1, p, contacts), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_closest_point(ctx, &field, 1, p, NULL, NULL, NULL), ctx);
    dist_context_destroy(ctx);
}

TEST(more_points_than_there_can_be_are_refused)
{
    dist_context *ctx = test_context();
    dist_net *net = dist_net_load_file(ctx, "examples/model.safetensors");
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    dist_instance instance;
    dist_gradients grads;
    size_t n = (size_t)-1;
    float p[4] = {0, 0, 0, 0}, d[3] = {0, 0, 0}, f[3];
    dist_hit hit;
    int index;
    memset(&instance, 0, sizeof instance);
    memset(&grads, 0, sizeof grads);
    instance.field = &field;
    dist_scene *scene = dist_scene_create(ctx, 1, &instance);
    for (int k = 0; k < 2; k++, n /= 2) {
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_eval(ctx, &field, n, p, f, NULL), ctx);
        CHECK_TEXT("dist_field_eval: n is", dist_context_message(ctx));
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_backward(ctx, &field, n, p, f, NULL, NULL, d, &grads), ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_eikonal(ctx, &field, n, p, 1.0f, f, NULL), ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_shape_eval(ctx, shape, n, p, f), ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_find(scene, n, p, &index), ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_trace(ctx, &field, n, p, d, NULL, &hit, NULL), ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_closest_point(ctx, &field, n, p, f, NULL, NULL), ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_collide(ctx, &field, n, p, contacts), ctx);
    }
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 1, p, d, NULL, &hit, NULL), ctx);
    CHECK_EQUAL(DIST_RAY_NOT_FINITE, hit.status); /* d is 0 */
    dist_scene_destroy(scene), dist_shape_destroy(shape), dist_net_destroy(net), dist_context_destroy(ctx);
}

/* Squares of these lengths do not fit a float. */
TEST(points_far_beyond_the_sphere_have_a_nearest_point)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.6, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    float p[6] = {1e30f, 0, 0, 0, -1e20f, 0}, spheres[8] = {1e30f, 0, 0, 1, 0, 1e20f, 0, 2e20f};
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, 2, p, closest, distance, status), ctx);
    for (int i = 0; i < 2; i++) CHECK_EQUAL(DIST_RAY_HIT, status[i]);
    CHECK_NEAR(0.6, closest[0], 1e-5);
    CHECK_NEAR(-0.6, closest[4], 1e-5);
    CHECK_NEAR(1e30, distance[0], 1e24);
    CHECK_NEAR(1e20, distance[1], 1e14);
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 2, spheres, contacts), ctx);
    CHECK_EQUAL(DIST_RAY_MISS, contacts[0].status);
    CHECK_NEAR(-1e30, contacts[0].depth, 1e24);
    CHECK_EQUAL(DIST_RAY_HIT, contacts[1].status);
    CHECK_NEAR(1e20, contacts[1].depth, 1e14);
    CHECK_NEAR(1.0, contacts[1].normal[1], 1e-6);
    float farther[4] = {3.4e38f, 0, 3.1f, 3.4e38f};
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 1, farther, contacts), ctx);
    CHECK_EQUAL(DIST_RAY_HIT, contacts[0].status);
    CHECK_NEAR(1.0, contacts[0].normal[0], 1e-6);
    dist_context_destroy(ctx);
}

/* f that would lead far away: nothing is asked beyond the sphere all the same. */
static long beyond;
static void huge_eval(void *user, int worker, size_t n, const float *p, float *sdf, float *gradient)
{
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        double square = 0.0;
        for (size_t k = 0; k < 3; k++) square += (double)p[3 * i + k] * (double)p[3 * i + k];
        beyond += !(square < 1.00001);
        sdf[i] = *(const float *)user;
    }
    if (gradient) memset(gradient, 0, 3 * n * sizeof(float));
}

/* A plane that passes beside the sphere. */
static void beside_eval(void *user, int worker, size_t n, const float *p, float *sdf, float *gradient)
{
    float none = 0;
    (void)user;
    huge_eval(&none, worker, n, p, sdf, gradient);
    for (size_t i = 0; i < n; i++) {
        sdf[i] = p[3 * i] - 1.01f;
        if (gradient) gradient[3 * i] = 1;
    }
}

TEST(no_f_leads_beyond_the_sphere)
{
    float values[4] = {3e38f, -3e38f, 1e9f, -1e9f}, spheres[8] = {0.3f, 0.2f, 0.1f, 0.5f, 0, 0, 0, 0.1f};
    dist_context *ctx = test_context();
    for (int k = 0; k < 5; k++) {
        dist_field field;
        memset(&field, 0, sizeof field);
        field.user = &values[k % 4];
        field.eval_fn = k < 4 ? huge_eval : beside_eval;
        field.radius = 1.0f;
        field.lipschitz = k < 2 ? 0.0f : k < 4 ? 1e-30f : 1.0f;
        beyond = 0;
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, 2, spheres, closest, distance, status), ctx);
        CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 2, spheres, contacts), ctx);
        CHECK_EQUAL(0, beyond);
        CHECK(test_finite_all(6, closest) && test_finite_all(2, distance));
        for (int i = 0; i < 2; i++)
            CHECK(test_finite_all(3, contacts[i].point) && test_finite((double)contacts[i].depth));
    }
    dist_context_destroy(ctx);
}

TEST(fields_too_far_from_0_are_refused)
{
    dist_context *ctx = test_context();
    float sphere[4] = {0, 2e15f, 0, 1}, p[3] = {0, 0, 0}, f;
    dist_field field = dist_field_sphere(sphere);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_eval(ctx, &field, 1, p, &f, NULL), ctx);
    CHECK_TEXT("dist_field_eval: field.center[1] is 2e15, must be within 1e15 of 0", dist_context_message(ctx));
    dist_context_destroy(ctx);
}

TEST(many_points_are_the_same_as_single_ones)
{
    enum { N = 1300 };
    static float alone[3];
    test_scheduler scheduler = {7, 0};
    dist_context_desc desc = test_context_desc();
    desc.workers = 7;
    desc.scheduler = test_scheduler_hook(&scheduler);
    dist_context *ctx = dist_context_create(&desc);
    float torus[5] = {0, 0, 0, 0.6f, 0.2f};
    dist_field field = dist_field_torus(torus);
    test_random random = test_random_seed(63);
    make_points(&random, 3, 1.5f);
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, N, points, closest, distance, status), ctx);
    for (int i = 0; i < N; i += 37) {
        float d;
        inside_soil(ctx, i & 1 ? 0 : 0xff);
        CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, 1, points + 3 * i, alone, &d, NULL), ctx);
        CHECK_BYTES(sizeof alone, closest + 3 * i, alone);
        CHECK_BYTES(sizeof d, distance + i, &d);
    }
    dist_context_destroy(ctx);
}

static size_t calls;

static void calls_counted_eval(void *user, int worker, size_t n, const float *at, float *sdf, float *gradient)
{
    calls++;
    counted_eval(user, worker, n, at, sdf, gradient);
}

/* Cells that a lone point looks into next go with the one that it waits for, of a net and of a field that says that
   many points at once are faster; but for how lone gradients are rounded nothing else changes. */
TEST(a_lone_point_looks_into_several_cells_at_once)
{
    enum { LONE = 60 };
    static const model_desc desc = {.name = "softplus", .code_size = 2, .activation = DIST_ACTIVATION_SOFTPLUS};
    static float answers[3][4 * LONE];
    size_t questions[3], visits[3];
    dist_context *ctx = shape_context();
    double code[MODEL_CODE] = {0.25, 0.25};
    float codef[2] = {0.25f, 0.25f};
    test_random random = test_random_seed(71);
    model m = model_make(&desc, 7);
    model_fit_ball(&m, code, 0.6);
    dist_net *net = model_load(ctx, &m);
    dist_shape *shape = dist_shape_create(ctx, net, codef);
    dist_field field = dist_shape_field(shape), by_one = field;
    by_one.user = &field;
    by_one.eval_fn = calls_counted_eval;
    make_points(&random, 3, 1.5f);
    for (int k = 0; k < 3; k++) {
        dist_field lone = by_one;
        if (k > 0) lone.fused_fn = NULL;
        lone.many = k == 2;
        asked = calls = 0;
        for (size_t i = 0; i < LONE; i++)
            CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &lone, 1, points + 3 * i, answers[k] + 3 * i,
                                                           answers[k] + 3 * LONE + i, NULL), ctx);
        questions[k] = asked;
        visits[k] = calls;
        if (test_state.verbose)
            printf("    %d: %lu queries, %lu calls\n", k, (unsigned long)asked, (unsigned long)calls);
        for (size_t i = 0; i < LONE; i++) CHECK(fabsf(answers[k][3 * LONE + i] - answers[0][3 * LONE + i]) <= 1e-4f);
    }
    CHECK_BYTES(sizeof answers[0], answers[0], answers[2]);
    CHECK(questions[1] == visits[1]);
    CHECK(3 * visits[0] < visits[1] && 3 * visits[2] < visits[1]);
    CHECK(10 * questions[0] < 11 * questions[1] && questions[0] == questions[2]);
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, LONE, points, closest, distance, status), ctx);
    for (size_t i = 0; i < LONE; i++) CHECK(fabsf(distance[i] - answers[0][3 * LONE + i]) <= 1e-4f);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    model_free(&m);
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(any_hit_finds_a_blocker_where_there_is_one_for_fewer_queries);
    RUN(a_ray_looks_as_far_as_it_is_told_in_lengths_of_its_direction);
    RUN(rays_that_look_beyond_all_floats_look_without_end);
    RUN(a_ray_that_looks_nowhere_knows_where_it_is);
    RUN(any_hit_and_max_distance_are_refused_where_they_mean_nothing);
    RUN(closest_points_of_distances_are_exact);
    RUN(what_is_far_away_finds_its_nearest_point_and_what_it_touches);
    RUN(points_find_the_nearest_instance_of_a_scene);
    RUN(what_is_of_one_instance_in_another_is_no_surface);
    RUN(fields_far_from_the_origin_are_found_to_within_what_floats_can_tell);
    RUN(closest_points_of_other_fields_are_on_the_surface_and_near);
    RUN(closest_points_of_networks_lie_on_their_surface);
    RUN(what_decoders_say_far_off_leads_to_the_nearest_part_all_the_same);
    RUN(closest_points_of_fields_without_an_inside_are_found);
    RUN(a_sphere_without_a_radius_is_a_point);
    RUN(the_nearest_of_small_parts_is_found_from_far_away);
    RUN(closest_points_of_smooth_surfaces_take_a_few_queries);
    RUN(a_nearer_part_of_the_surface_is_found_by_looking_around);
    RUN(closest_points_of_thin_boards_are_found);
    RUN(contacts_have_the_depth_and_the_normal_of_the_shape);
    RUN(spheres_that_are_clear_cost_one_query_or_none);
    RUN(spheres_are_no_farther_off_than_was_looked);
    RUN(no_sphere_that_touches_a_steep_field_is_told_to_be_clear);
    RUN(spheres_touch_the_instance_that_is_there);
    RUN(what_has_no_answer_says_so);
    RUN(more_points_than_there_can_be_are_refused);
    RUN(points_far_beyond_the_sphere_have_a_nearest_point);
    RUN(no_f_leads_beyond_the_sphere);
    RUN(fields_too_far_from_0_are_refused);
    RUN(many_points_are_the_same_as_single_ones);
    RUN(a_lone_point_looks_into_several_cells_at_once);
    return test_report();
}
