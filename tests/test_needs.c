/* SPDX-License-Identifier: MIT-0
   What a scene does not need it does not pay for: the rows of bench/bench_needs.c, by their counts. */
#include "test.h"
#include "../examples/common.h"
#include "../bench/bench.h"
#include "../bench/needs.h"

enum { SIZE = 96 };
static need_result results[NEEDS];

static const dist_stats *stats_of(int row) { return &results[row].stats; }

TEST(every_row_is_rendered)
{
    for (int i = 0; i < NEEDS; i++) {
        results[i] = need_run("embedded", 5, SIZE, 1, &needs[i]);
        const dist_stats *s = stats_of(i);
        int points = i == NEED_POINTS || i == NEED_POINTS_GRADIENT;
        CHECK_EQUAL(points ? 20 : SIZE * SIZE, s->rays);
        CHECK(s->hits > (points ? 10 : SIZE * SIZE / 10) && s->queries >= s->hits && s->queries < 4 * SIZE * SIZE);
        CHECK(s->operations_done > 0 && s->operations_done < s->operations);
    }
}

TEST(a_plane_that_is_not_wanted_costs_no_query)
{
    const dist_stats *depth = stats_of(NEED_DEPTH), *outline = stats_of(NEED_SILHOUETTE);
    const dist_stats *normals = stats_of(NEED_NORMALS);
    CHECK_EQUAL(0, depth->silhouette_queries + depth->normal_queries + depth->color_queries);
    CHECK(outline->silhouette_queries > 0);
    CHECK(outline->queries < depth->queries + 2 * outline->silhouette_queries);
    CHECK_EQUAL(0, outline->normal_queries);
    CHECK_EQUAL(normals->hits, normals->normal_queries); /* one each, value and gradient in one pass */
    CHECK_EQUAL(outline->queries + normals->hits, normals->queries);
}

TEST(a_gradient_costs_no_query_and_only_the_points_that_have_one)
{
    const dist_stats *depth = stats_of(NEED_DEPTH_GRADIENT), *all = stats_of(NEED_GRADIENT);
    CHECK_EQUAL(stats_of(NEED_NORMALS)->queries, all->queries);
    CHECK_EQUAL(stats_of(NEED_DEPTH)->queries, depth->queries);
    CHECK_EQUAL(depth->hits, depth->backward_points);
    CHECK(all->backward_points > depth->backward_points);
    for (int i = 0; i < NEEDS; i++)
        if (!(needs[i].planes & GRADIENT)) CHECK_EQUAL(0, stats_of(i)->backward_points);
}

TEST(twenty_points_cost_twenty_rays)
{
    const dist_stats *s = stats_of(NEED_POINTS);
    CHECK(s->queries <= 20 * 15);
    CHECK_EQUAL(s->queries, stats_of(NEED_POINTS_GRADIENT)->queries);
    CHECK_EQUAL(s->hits, stats_of(NEED_POINTS_GRADIENT)->backward_points);
}

TEST(a_static_camera_costs_about_two_queries_a_hit)
{
    const dist_stats *cold = stats_of(NEED_STEP), *warm = stats_of(NEED_WARM_STEP), *still = stats_of(NEED_WARM);
    CHECK(5 * warm->queries < cold->queries);
    CHECK_NEAR(cold->hits, warm->hits, 0.01 * (double)cold->hits);
    CHECK(still->queries < 2 * still->hits && 5 * still->queries < stats_of(NEED_DEPTH)->queries);
    CHECK_NEAR(stats_of(NEED_DEPTH)->hits, still->hits, 0.01 * (double)still->hits);
}

/* Nine more out of view are not asked: the field's work is at most that of the one by itself, which is in a smaller
   sphere there. */
TEST(instances_out_of_view_cost_nothing)
{
    CHECK(stats_of(NEED_TEN)->operations <= stats_of(NEED_DEPTH)->operations);
    CHECK_NEAR(stats_of(NEED_DEPTH)->hits, stats_of(NEED_TEN)->hits, 3); /* outlines: another sphere is entered */
}

TEST(memory_is_the_tracers_and_the_nets_and_a_tape_only_where_one_is_wanted)
{
    size_t none = results[NEED_DEPTH].bytes, tape = results[NEED_DEPTH_GRADIENT].bytes;
    size_t pixels = SIZE * SIZE;
    for (int i = 0; i < NEEDS; i++) {
        int planes = needs[i].planes;
        if (planes & TEN) continue;
        CHECK_EQUAL(planes & WARM ? tape + 12 * pixels : planes & GRADIENT ? tape : none, results[i].bytes);
    }
    CHECK(tape - none < 5 * pixels + 1000000); /* the backward pass's own is the same for every picture */
    CHECK(results[NEED_TEN].bytes - none < 500000);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(every_row_is_rendered);
    RUN(a_plane_that_is_not_wanted_costs_no_query);
    RUN(a_gradient_costs_no_query_and_only_the_points_that_have_one);
    RUN(twenty_points_cost_twenty_rays);
    RUN(a_static_camera_costs_about_two_queries_a_hit);
    RUN(instances_out_of_view_cost_nothing);
    RUN(memory_is_the_tracers_and_the_nets_and_a_tape_only_where_one_is_wanted);
    return test_report();
}
