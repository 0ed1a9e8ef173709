/* SPDX-License-Identifier: MIT-0
   Parts that no declaration shows: single steps of the tracer's rays, from states that rays of decoders were in, and
   the order in which a net's points are put. */
#include "shapes.h"

static dist_render_desc plain_how(void)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    return how;
}

static disti_sample sample(float s, float f)
{
    disti_sample made = {s, f};
    return made;
}

/* What rays of decoders met: f came down at a slope that foretold a crossing half way to where it crossed again; kept a
   height of 0.7 epsilon for 17 times as far as its slope said; and crossed 0 at .23 of a coarse bracket, not at .1. */
TEST(bounds_reach_to_where_f_was_foretold_to_cross_and_over_what_is_flat)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.8, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    disti_tracer tracer;
    disti_ray ray;
    for (int certified = 0; certified < 2; certified++) {
        dist_render_desc how = plain_how();
        how.certified = certified;
        CHECK_STATUS(DIST_OK, disti_tracer_init(&tracer, ctx, &field, &how, "test"), ctx);
        memset(&ray, 0, sizeof ray);
        ray.sign = 1;
        ray.known = 1;
        ray.slope = -0.4373f;
        CHECK(disti_ray_open_bracket(&tracer, &ray, sample(0, 5.211e-3f), sample(2.34e-2f, -5e-7f)));
        CHECK_EQUAL(0, disti_ray_bracketed(&tracer, &ray, sample(ray.q, -1.3e-6f)));
        CHECK_EQUAL(DIST_RAY_HIT, ray.status);
        CHECK(ray.error > (certified ? 1.8e-2f : 9.3e-3f)); /* was 2e-5; so much of it is not proven to be empty */
    }
    tracer.how.certified = 1;
    CHECK(disti_ray_open_bracket(&tracer, &ray, sample(0, 5.211e-3f), sample(5.2115e-3f, -5e-7f))); /* but this is */
    CHECK_EQUAL(0, disti_ray_bracketed(&tracer, &ray, sample(ray.q, 5.211e-3f - ray.q)));
    CHECK(ray.error < 1e-5f);
    /* as short as two epsilons */
    CHECK_EQUAL(0, disti_ray_open_bracket(&tracer, &ray, sample(0, 3e-5f), sample(9e-5f, -3e-5f)));
    CHECK_EQUAL(DIST_RAY_HIT, ray.status);
    CHECK_NEAR(4.5e-5, ray.best, 1e-9);
    CHECK_NEAR(9e-5, ray.error, 1e-9);
    CHECK(disti_ray_alone(&tracer, &ray, sample(0, 0.1f), sample(0.5f, -0.5f), 0));
    tracer.far = 0.1f; /* twice as steep where |f| is larger: 0.5 is at least 0.3 deep, not 0.5 */
    tracer.ratio = 0.5f;
    CHECK(!disti_ray_alone(&tracer, &ray, sample(0, 0.1f), sample(0.5f, -0.5f), 0));
    CHECK_STATUS(DIST_OK, disti_tracer_init(&tracer, ctx, &field, NULL, "test"), ctx);
    memset(&ray, 0, sizeof ray);
    ray.sign = 1;
    ray.base = 2;
    ray.leave = 0.5f;
    ray.a.f = 3e38f;
    ray.incline = -0.4686f;
    ray.width = 4;
    CHECK_EQUAL(0, disti_ray_predicted(&tracer, &ray, sample(ray.q, 3.572e-5f)));
    CHECK_EQUAL(DIST_RAY_HIT, ray.status);
    CHECK(ray.error > 1.28e-3f && ray.error < 2e-3f);
    dist_render_desc how = plain_how();
    how.epsilon = 1e-2f;
    CHECK_STATUS(DIST_OK, disti_tracer_init(&tracer, ctx, &field, &how, "test"), ctx);
    memset(&ray, 0, sizeof ray);
    ray.sign = 1;
    ray.slope = -1;
    CHECK_EQUAL(0, disti_ray_open_bracket(&tracer, &ray, sample(0, 4e-4f), sample(4e-3f, -3.6e-3f)));
    CHECK_EQUAL(DIST_RAY_HIT, ray.status);
    CHECK(ray.error > 1.1e-3f && ray.error < 2.1e-3f); /* was 8e-4 */
    dist_context_destroy(ctx);
}

/* What rays of decoders went through: a jump by two samples ended where f was 3e-5, not .0075 as foretold, behind a
   wall; one ended at about what was foretold, but from there f rose as from a crossing before it. A sample that a jump
   brought, and the check took back, is where the bracket begins: f was flat from there on. */
TEST(steps_that_may_have_gone_through_something_are_taken_back)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_SPHERE, 0.8, 0, 0, 0);
    dist_field field = shape_field(&shape, 1, 1.125);
    dist_render_desc how = plain_how();
    disti_tracer tracer;
    disti_ray ray;
    CHECK_STATUS(DIST_OK, disti_tracer_init(&tracer, ctx, &field, &how, "test"), ctx);
    memset(&ray, 0, sizeof ray);
    ray.sign = ray.leave = 1;
    ray.base = 2;
    ray.known = 1;
    ray.mode = DISTI_JUMP;
    ray.front.s = 0.25487f;
    ray.front.f = 3.8564e-2f;
    ray.slope = -0.2855f;
    CHECK(!disti_ray_trusts(&tracer, &ray, 3.4974e-5f, 0.108897f));
    CHECK(disti_ray_trusts(&tracer, &ray, 3.7e-3f, 0.108897f));
    ray.a.s = 0.341199f;
    ray.a.f = 2.388e-2f;
    ray.front.s = 0.404929f;
    ray.front.f = 1.0003e-2f;
    ray.slope = -0.2178f;
    ray.q = 0.431654f;
    CHECK(disti_ray_doubts(&tracer, &ray, 2.4429e-2f, ray.q - ray.front.s));
    CHECK(!disti_ray_doubts(&tracer, &ray, 1.2e-2f, ray.q - ray.front.s)); /* so gently, f was above 0 all the way */
    CHECK_EQUAL(1, disti_ray_advance(&tracer, &ray, 2.4429e-2f));
    CHECK_NEAR(0.341199, ray.front.s, 1e-6);
    CHECK_NEAR(0.404929, ray.b.s, 1e-6);
    CHECK(ray.q > ray.front.s && ray.q < ray.b.s && ray.mode == DISTI_MARCH);
    tracer.how.certified = 1;
    ray.a.f = 2.388e-2f;
    CHECK(!disti_ray_doubts(&tracer, &ray, 2.4429e-2f, 0.0267f)); /* nothing was trusted there */
    tracer.how.certified = 0;
    memset(&ray, 0, sizeof ray);
    ray.sign = 1;
    ray.known = 1;
    ray.slope = -0.7227f;
    ray.best = 8.1e-3f;
    ray.fbest = 2.3094e-4f;
    ray.mode = DISTI_JUMP;
    CHECK_EQUAL(1, disti_ray_open_bracket(&tracer, &ray, sample(0, 8.2277e-3f), sample(3.03e-2f, -7.0323e-3f)));
    CHECK(ray.a.s > 8e-3f && ray.a.f < 2.4e-4f && ray.target > 2e-2f);
    ray.mode = DISTI_BACK; /* warm start: best is of another picture */
    CHECK_EQUAL(1, disti_ray_open_bracket(&tracer, &ray, sample(0, 8.2277e-3f), sample(3.03e-2f, -7.0323e-3f)));
    CHECK_NEAR(0, ray.a.s, 0);
    for (int skips = 0; skips < 2; skips++) { /* along ripples of f, or past spheres to f = 0: from there on, or... */
        memset(&ray, 0, sizeof ray);
        ray.sign = ray.leave = 1;
        ray.known = 1;
        ray.mode = skips ? DISTI_SKIP : DISTI_MARCH;
        ray.base = 2;
        ray.footprint = 1e-3f;
        ray.front.s = 0.1739f;
        ray.front.f = 1.652e-4f;
        ray.slope = -0.087f;
        ray.q = skips ? 0.18f : 0.1756f;
        CHECK_EQUAL(1, disti_ray_advance(&tracer, &ray, skips ? 4e-6f : 1.82e-5f));
        CHECK_NEAR(0.1739, ray.crept.s, 1e-6);
        ray.a.s = 0.1759f;
        ray.b.s = 0.176f;
        ray.a.f = 1e-5f;
        ray.b.f = -2e-5f;
        ray.incline = -0.3f;
        ray.target = 0;
        CHECK_NEAR(0.176 - 0.1739, disti_ray_kink(&tracer, &ray, 0.35f), 1e-6);
        CHECK(disti_ray_kink(&tracer, &ray, 0.15f) < 1e-4f); /* but not where f falls as it did all the way, */
        disti_ray_creeps(&tracer, &ray, sample(ray.q, 6e-4f), 0);
        CHECK(disti_ray_kink(&tracer, &ray, 0.35f) < 1e-4f); /* or has been well above 0 since */
        tracer.how.certified = 1;
        disti_ray_creeps(&tracer, &ray, sample(ray.q, 1e-5f), 1);
        CHECK(!(ray.crept.f > 0)); /* nothing was trusted */
        tracer.how.certified = 0;
    }
    for (int coarse = 0; coarse < 2; coarse++) { /* foretold was f = 0; hardly less than at the front, it is flat */
        for (int fell = 0; fell < 2; fell++) {
            how.epsilon = coarse ? 1e-2f : 1e-3f;
            CHECK_STATUS(DIST_OK, disti_tracer_init(&tracer, ctx, &field, &how, "test"), ctx);
            memset(&ray, 0, sizeof ray);
            ray.sign = 1;
            ray.base = 2;
            ray.leave = 0.5f;
            ray.front.f = fell ? 5.4e-2f : 5.54e-4f;
            ray.a.f = 3e38f;
            ray.q = 9.4e-4f;
            ray.incline = -0.889f;
            ray.width = 4;
            CHECK_EQUAL(fell ? 0 : 1, disti_ray_predicted(&tracer, &ray, sample(ray.q, 5.39e-4f)));
            CHECK(fell || (ray.mode != DISTI_PREDICT && ray.mode != DISTI_DONE));
            CHECK(!fell || (ray.error >= 0.75f * how.epsilon && ray.error < how.epsilon + 5e-3f)); /* of one sample */
        }
    }
    dist_context_destroy(ctx);
}

/* Pixels of the lattice of 8 were not predicted, (4, y) from 4 pixels away, (2, y) and (6, y) from 2, all others from
   next to them. */
TEST(what_neighbors_were_off_counts_by_the_distance_they_were_predicted_from)
{
    disti_ray before, behind;
    disti_guess guess;
    memset(&before, 0, sizeof before);
    memset(&behind, 0, sizeof behind);
    memset(&guess, 0, sizeof guess);
    before.off = 3e-4f;
    disti_guess_off(&guess, &before, &behind, DISTI_LATTICE, 3, 2, 1);
    CHECK(!(guess.off > 0)); /* nothing is known of (4, 2), so nothing of (3, 2) */
    behind.off = 8e-4f;
    disti_guess_off(&guess, &before, &behind, DISTI_LATTICE, 3, 0, 1); /* (2, 0) from 2, (4, 0) from 4 pixels away */
    CHECK_NEAR(2e-4, guess.off, 1e-9);
    CHECK_NEAR(8e-4, guess.seen, 1e-9);
    /* (4, 0); (8, 0) is of the lattice, whatever its ray says */
    disti_guess_off(&guess, &before, &behind, DISTI_LATTICE, 6, 0, 2);
    CHECK_NEAR(1.5e-4, guess.off, 1e-9);
    CHECK_NEAR(3e-4, guess.seen, 1e-9);
    /* (16, 24) is of it, too; (18, 24) speaks for both */
    disti_guess_off(&guess, &before, &behind, DISTI_LATTICE, 17, 24, 1);
    CHECK_NEAR(4e-4, guess.off, 1e-9);
    disti_guess_off(&guess, &before, &behind, DISTI_LATTICE, 5, 7, 1); /* (4, 7) and (6, 7): from next to them */
    CHECK_NEAR(8e-4, guess.off, 1e-9);
    behind.kept = 1;
    disti_guess_off(&guess, &before, &behind, DISTI_LATTICE, 3, 0, 1); /* a warm start's */
    CHECK_NEAR(8e-4, guess.off, 1e-9);
    memset(&guess, 0, sizeof guess);
    behind.kept = 0;
    disti_guess_off(&guess, &before, &behind, DISTI_LATTICE, 4, 0, 4); /* both of the lattice */
    CHECK(!(guess.off > 0) && !(guess.seen > 0));
}

/* A step of Newton's along a slope of a quarter from a positive sample ends a ray only if the sample is within epsilon;
   along a steeper one the step may be twelve of them long. */
TEST(flat_rays_end_at_samples_within_epsilon)
{
    dist_context *ctx = shape_context();
    test_shape shape = shape_make(SHAPE_TORUS, 0.6, 0.25, 0, 0);
    dist_field field = shape_field(&shape, 1, 1);
    dist_render_desc how = plain_how();
    how.epsilon = 1e-4f;
    for (int k = 0; k < 8; k++) {
        disti_tracer tracer;
        disti_ray ray;
        float slope = k & 1 ? -0.25f : -0.5f, f = k & 2 ? 2.5e-4f : 9e-5f, sign = k & 4 ? -1.0f : 1.0f;
        CHECK_STATUS(DIST_OK, disti_tracer_init(&tracer, ctx, &field, &how, "test"), ctx);
        memset(&ray, 0, sizeof ray);
        ray.sign = 1;
        ray.base = 2;
        ray.leave = 0.5f;
        ray.front.f = 0.01f;
        ray.front.s = -0.02f;
        ray.a.s = -3e-3f;
        ray.a.f = sign * f - 3e-3f * slope; /* the slope of the last two samples */
        CHECK_EQUAL(k == 3 ? 1 : 0, disti_ray_predicted(&tracer, &ray, sample(ray.q, sign * f)));
        CHECK(k == 3 || ray.status == DIST_RAY_HIT);
    }
    dist_context_destroy(ctx);
}

/* Every point once, whatever they are: in a box, on a line, at a few places only, all alike, not finite. Each cell is
   small where they are spread out, and what ends a group lies on one side of what begins the next. */
TEST(points_put_in_order_are_all_there_and_neighbors_stand_together)
{
    enum { MOST = 3000, CELL = DISTI_CELL_POINTS };
    static float points[3 * MOST];
    static disti_place place[MOST];
    static unsigned char seen[MOST];
    const int counts[] = {0, 1, 2, CELL, CELL + 1, DISTI_BLOCK + 1, DISTI_GROUP_POINTS, 1000, MOST};
    test_random r = test_random_seed(11);
    for (int kind = 0; kind < 5; kind++) {
        for (size_t c = 0; c < sizeof counts / sizeof counts[0]; c++) {
            int n = counts[c], once = 1;
            double extent = 0;
            for (int i = 0; i < 3 * n; i++) {
                float x = test_random_float(&r, -1, 1);
                points[i] = kind == 0                ? x
                            : kind == 1              ? (i % 3 == 1 ? x : 0.0f)
                            : kind == 2              ? floorf(2 * x)
                            : kind == 4 && i % 7 < 3 ? (i % 2 ? NAN : INFINITY)
                                                     : 0.25f;
            }
            memset(seen, 0, sizeof seen);
            disti_places_init(place, points, n);
            disti_sort_places(place, 0, n, CELL);
            for (int i = 0; i < n; i++) {
                once &= place[i].at >= 0 && place[i].at < n && !seen[place[i].at]++;
                once &= memcmp(place[i].p, points + 3 * place[i].at, 3 * sizeof(float)) == 0;
            }
            CHECK(once);
            for (int at = 0; at + CELL <= n && kind == 0; at += CELL) {
                for (int k = 0; k < 3; k++) {
                    float low = 2, high = -2;
                    for (int i = at; i < at + CELL; i++) {
                        low = fminf(low, place[i].p[k]);
                        high = fmaxf(high, place[i].p[k]);
                    }
                    extent += (double)(high - low) / (3.0 * n / CELL);
                }
            }
            if (kind == 0 && n == MOST) CHECK(extent < 0.4); /* 2 / 250^(1/3) = 0.32; 1.7 in any order */
        }
    }
}

static void run_parts(void)
{
    RUN(bounds_reach_to_where_f_was_foretold_to_cross_and_over_what_is_flat);
    RUN(steps_that_may_have_gone_through_something_are_taken_back);
    RUN(what_neighbors_were_off_counts_by_the_distance_they_were_predicted_from);
    RUN(flat_rays_end_at_samples_within_epsilon);
    RUN(points_put_in_order_are_all_there_and_neighbors_stand_together);
}
