/* SPDX-License-Identifier: MIT-0
   Cameras: where things appear, conversions there and back, steps, and what is no camera. */
#include "test.h"

/* Rows of the matrix of a unit quaternion, in double. */
static void quaternion_matrix(const double q[4], double m[9])
{
    double w = q[0], x = q[1], y = q[2], z = q[3];
    m[0] = w * w + x * x - y * y - z * z;
    m[1] = 2 * (x * y - w * z);
    m[2] = 2 * (x * z + w * y);
    m[3] = 2 * (x * y + w * z);
    m[4] = w * w - x * x + y * y - z * z;
    m[5] = 2 * (y * z - w * x);
    m[6] = 2 * (x * z - w * y);
    m[7] = 2 * (y * z + w * x);
    m[8] = w * w - x * x - y * y + z * z;
}

static void random_quaternion(test_random *r, double q[4])
{
    double length = 0;
    for (int i = 0; i < 4; i++) {
        q[i] = test_random_normal(r);
        length += q[i] * q[i];
    }
    for (int i = 0; i < 4; i++) q[i] /= sqrt(length);
}

static void random_pose(test_random *r, dist_camera *camera)
{
    double q[4], m[9];
    random_quaternion(r, q);
    quaternion_matrix(q, m);
    for (int i = 0; i < 9; i++) camera->rotation[i] = (float)m[i];
    test_random_fill(r, 3, camera->translation, -3.0f, 3.0f);
}

static dist_camera plain_camera(void)
{
    float eye[3] = {0, 0, -3}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    return dist_camera_look_at(64, 48, 0.8f, eye, at, up);
}

/* x_cam = R x + t and its pixel, in double. */
static void project(const dist_camera *c, const double x[3], double seen[3], double pixel[2])
{
    for (int i = 0; i < 3; i++) {
        seen[i] = (double)c->translation[i];
        for (int j = 0; j < 3; j++) seen[i] += (double)c->rotation[3 * i + j] * x[j];
    }
    pixel[0] = (double)c->fx * seen[0] / seen[2] + (double)c->skew * seen[1] / seen[2] + (double)c->cx;
    pixel[1] = (double)c->fy * seen[1] / seen[2] + (double)c->cy;
}

static double off_orthonormal(const float m[9])
{
    double worst = 0;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            double dot = 0;
            for (int k = 0; k < 3; k++) dot += (double)m[3 * i + k] * (double)m[3 * j + k];
            worst = fmax(worst, fabs(dot - (i == j)));
        }
    }
    return worst;
}

static double determinant(const float f[9])
{
    double m[9];
    for (int i = 0; i < 9; i++) m[i] = (double)f[i];
    return m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) + m[2] * (m[3] * m[7] - m[4] * m[6]);
}

TEST(look_at_follows_its_formula)
{
    float eye[3] = {1, 2, 3}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera c = dist_camera_look_at(640, 480, 0.9f, eye, at, up);
    double f = 240.0 / tan((double)0.9f / 2);
    CHECK_NEAR(f, c.fx, 1e-4);
    CHECK_NEAR(f, c.fy, 1e-4);
    CHECK_NEAR(319.5, c.cx, 0);
    CHECK_NEAR(239.5, c.cy, 0);
    CHECK_NEAR(0, c.skew, 0);
    CHECK_NEAR(0, c.pixel_center, 0);
    CHECK_EQUAL(640, c.width);
    CHECK_EQUAL(480, c.height);
    CHECK(off_orthonormal(c.rotation) < 1e-6);
    CHECK_NEAR(1, determinant(c.rotation), 1e-6);
}

TEST(look_at_sees_x_right_y_down_z_forward)
{
    dist_camera c = plain_camera(); /* at z = -3, looking along +z, up = +y: +x is to the left */
    const double world[4][3] = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    const double expected[4][3] = {{0, 0, 3}, {-1, 0, 3}, {0, -1, 3}, {0, 0, 4}};
    double seen[3], pixel[2];
    for (int k = 0; k < 4; k++) {
        project(&c, world[k], seen, pixel);
        for (int i = 0; i < 3; i++) CHECK_NEAR(expected[k][i], seen[i], 1e-6);
    }
    project(&c, world[0], seen, pixel);
    CHECK_NEAR(31.5, pixel[0], 1e-5);
    CHECK_NEAR(23.5, pixel[1], 1e-5);
    project(&c, world[2], seen, pixel);
    CHECK(pixel[1] < 23.5);
}

TEST(look_at_repairs_a_degenerate_view)
{
    const float eyes[6][3] = {{0, 2, 0}, {0, -2, 0}, {1, 1, 1}, {0, 0, 2}, {0, 0, 0}, {1e20f, 0, 0}};
    const float ups[6][3] = {{0, 1, 0}, {0, 1, 0}, {1, 1, 1}, {0, 0, 0}, {0, 1, 0}, {0, 1, 0}};
    const float at[3] = {0, 0, 0};
    for (int k = 0; k < 6; k++) {
        dist_camera c = dist_camera_look_at(8, 8, 0.7f, eyes[k], at, ups[k]);
        CHECK(off_orthonormal(c.rotation) < 1e-6);
        CHECK_NEAR(1, determinant(c.rotation), 1e-6);
        double length = sqrt((double)eyes[k][0] * (double)eyes[k][0] + (double)eyes[k][1] * (double)eyes[k][1] +
                             (double)eyes[k][2] * (double)eyes[k][2]);
        for (int i = 0; length > 0 && i < 3; i++) CHECK_NEAR(-(double)eyes[k][i] / length, c.rotation[6 + i], 1e-6);
    }
    dist_camera none = dist_camera_look_at(8, 8, 0.7f, NULL, NULL, NULL);
    CHECK(off_orthonormal(none.rotation) < 1e-6);
    dist_camera least = dist_camera_look_at(INT32_MIN, INT32_MIN, 0.7f, NULL, NULL, NULL); /* refused later */
    CHECK_EQUAL(INT32_MIN, least.width);
}

TEST(look_at_of_garbage_gives_a_camera_that_render_refuses)
{
    dist_context *ctx = test_context();
    float ball[4] = {0, 0, 0, 0.5f}, eye[3] = {0, 0, 2}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0}, depth[64];
    dist_field field = dist_field_sphere(ball);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = depth;
    uint32_t bits = 0x7fc00000u;
    float nan;
    memcpy(&nan, &bits, sizeof nan);
    float bad[3] = {nan, 0, 2};
    const dist_camera cameras[9] = {
        dist_camera_look_at(8, 8, 2e-38f, eye, at, up) /* fx beyond a float */,
        dist_camera_look_at(8, 8, nan, eye, at, up), dist_camera_look_at(8, 8, 0.7f, bad, at, up),
        dist_camera_look_at(8, 8, 0.7f, eye, bad, up), dist_camera_look_at(8, 8, 0.0f, eye, at, up),
        dist_camera_look_at(8, 8, 50.0f, eye, at, up) /* degrees */, dist_camera_look_at(8, 8, -1.0f, eye, at, up),
        dist_camera_look_at(8, 8, 3.2f, eye, at, up), dist_camera_look_at(8, 8, 1e30f, eye, at, up)};
    CHECK_NEAR(0.0, (double)cameras[0].fx, 0);
    for (int k = 0; k < 9; k++) {
        dist_context_clear(ctx);
        CHECK(dist_render(ctx, &field, &cameras[k], NULL, &out, NULL) < 0);
        CHECK_TEXT("dist_render: camera", dist_context_message(ctx));
    }
    dist_context_destroy(ctx);
}

TEST(rays_are_those_of_double)
{
    test_random r = test_random_seed(5);
    for (int k = 0; k < 200; k++) {
        dist_camera c = plain_camera();
        random_pose(&r, &c);
        c.fx = test_random_float(&r, 10, 300) *
               (k % 3 ? 1.0f : -1.0f); /* row 27: unlike, mirrored, skewed, off the picture */
        c.fy = test_random_float(&r, 10, 300);
        c.skew = test_random_float(&r, -5, 5);
        c.cx = test_random_float(&r, -500, 500);
        c.cy = test_random_float(&r, -500, 500);
        c.pixel_center = k % 2 ? 0.5f : 0.0f;
        float x = test_random_float(&r, -10, 70), y = test_random_float(&r, -10, 70), origin[3], direction[3];
        dist_camera_ray(&c, x, y, origin, direction);
        double length = 0, seen[3], pixel[2], p[3];
        for (int i = 0; i < 3; i++) {
            length += (double)direction[i] * (double)direction[i];
            p[i] = (double)origin[i] + 2.5 * (double)direction[i];
        }
        CHECK_NEAR(1, length, 1e-6);
        project(&c, p, seen, pixel);
        CHECK(seen[2] > 0);
        double far = 1 + fabs(pixel[0]) + fabs(pixel[1]) + fabs((double)c.cx) + fabs((double)c.cy);
        double steep = 1 / (seen[2] / 2.5); /* a float's error in the direction, seen from the side */
        CHECK_NEAR((double)x + (double)c.pixel_center, pixel[0], 2e-6 * far * steep * steep);
        CHECK_NEAR((double)y + (double)c.pixel_center, pixel[1], 2e-6 * far * steep * steep);
        for (int i = 0; i < 3; i++) p[i] = (double)origin[i];
        project(&c, p, seen, pixel);
        for (int i = 0; i < 3; i++) CHECK_NEAR(0, seen[i], 3e-6);
    }
}

TEST(pixel_center_shifts_rays_by_half_a_pixel)
{
    dist_camera a = plain_camera(), b = a;
    float o[3], d[3], e[3];
    b.pixel_center = 0.5f;
    dist_camera_ray(&a, 10.5f, 7.5f, o, d);
    dist_camera_ray(&b, 10, 7, o, e);
    CHECK_NEAR_ARRAY(3, d, e, 0);
}

TEST(opengl_goes_there_and_back)
{
    test_random r = test_random_seed(6);
    for (int k = 0; k < 100; k++) {
        dist_camera c = plain_camera(), back = plain_camera();
        float m[12];
        random_pose(&r, &c);
        dist_camera_get_opengl(&c, m);
        dist_camera_set_opengl(&back, m);
        CHECK_NEAR_ARRAY(9, c.rotation, back.rotation, 3e-7);
        CHECK_NEAR_ARRAY(3, c.translation, back.translation, 3e-6);
        float again[12];
        dist_camera_get_opengl(&back, again);
        CHECK_NEAR_ARRAY(12, m, again, 3e-6);
    }
}

/* A matrix of three to five digits, as a text file has them: its rows are not quite orthonormal, and its last column is
   where the camera stands all the same. */
TEST(opengl_of_few_digits_stands_where_it_says)
{
    test_random r = test_random_seed(16);
    for (int k = 0; k < 200; k++) {
        dist_camera c = plain_camera(), back = plain_camera();
        double digits = k % 2 ? 4e3 : 1e5;
        float m[12], again[12];
        random_pose(&r, &c);
        dist_camera_get_opengl(&c, m);
        for (int i = 0; i < 12; i++)
            if (i % 4 < 3) m[i] = (float)(floor((double)m[i] * digits + 0.5) / digits);
            else m[i] *= 5;
        dist_camera_set_opengl(&back, m);
        dist_camera_get_opengl(&back, again);
        for (int i = 0; i < 3; i++) CHECK_NEAR(m[4 * i + 3], again[4 * i + 3], 1e-5);
        for (int i = 0; i < 12; i++)
            if (i % 4 < 3) CHECK_NEAR(m[i], again[i], 2e-3);
    }
    dist_context *ctx = test_context(); /* a mirror stays one, and is refused */
    const float mirror[12] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 3};
    float ball[4] = {0, 0, 0, 0.5f}, depth[64];
    dist_field field = dist_field_sphere(ball);
    dist_camera c = dist_camera_look_at(8, 8, 0.7f, NULL, NULL, NULL);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = depth;
    dist_camera_set_opengl(&c, mirror);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &c, NULL, &out, NULL), ctx);
    CHECK_TEXT("not a rotation", dist_context_message(ctx));
    dist_context_destroy(ctx);
}

TEST(opengl_looks_along_minus_z_with_y_up)
{
    dist_camera c = plain_camera();
    const float m[12] = {1, 0, 0, 0.25f, 0, 1, 0, 0.5f, 0, 0, 1, 3}; /* at (.25, .5, 3), looking along -z */
    dist_camera_set_opengl(&c, m);
    const double ahead[3] = {0.25, 0.5, 1}, right[3] = {1.25, 0.5, 1}, above[3] = {0.25, 1.5, 1};
    double seen[3], pixel[2];
    project(&c, ahead, seen, pixel);
    CHECK_NEAR(0, seen[0], 1e-6);
    CHECK_NEAR(0, seen[1], 1e-6);
    CHECK_NEAR(2, seen[2], 1e-6);
    project(&c, right, seen, pixel);
    CHECK_NEAR(1, seen[0], 1e-6);
    project(&c, above, seen, pixel);
    CHECK_NEAR(-1, seen[1], 1e-6);
    CHECK_NEAR(0, c.pixel_center, 0);
}

TEST(colmap_goes_there_and_back_in_every_branch)
{
    test_random r = test_random_seed(7);
    int largest[4] = {0, 0, 0, 0};
    for (int k = 0; k < 400; k++) {
        double q[4], m[9];
        random_quaternion(&r, q);
        if (k % 5 == 4) q[k / 5 % 4] = 0;                                      /* a zero among the four */
        if (k < 4) q[0] = k == 0, q[1] = k == 1, q[2] = k == 2, q[3] = k == 3; /* half turns about the axes */
        double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int i = 0; i < 4; i++) q[i] /= length;
        float scale = k % 3 == 0 ? 1.0f : k % 3 == 1 ? -1.0f : k % 2 ? 7.5f : 1e-30f; /* -q is the same; any length */
        float quaternion[4], back[4], t[3] = {1, -2, 3}, t_back[3];
        for (int i = 0; i < 4; i++) quaternion[i] = (float)q[i] * scale;
        dist_camera c = plain_camera();
        CHECK_EQUAL(DIST_OK, dist_camera_set_colmap(&c, quaternion, t));
        quaternion_matrix(q, m);
        for (int i = 0; i < 9; i++) CHECK_NEAR(m[i], c.rotation[i], 4e-7);
        CHECK_NEAR(0.5, c.pixel_center, 0);
        dist_camera_get_colmap(&c, back, t_back);
        CHECK_NEAR_ARRAY(3, t, t_back, 0);
        double dot = 0;
        int most = 0;
        for (int i = 0; i < 4; i++) {
            dot += q[i] * (double)back[i];
            most = fabs(q[i]) > fabs(q[most]) ? i : most;
        }
        largest[most]++;
        for (int i = 0; i < 4; i++) CHECK_NEAR(dot < 0 ? -q[i] : q[i], back[i], 4e-7);
        CHECK(back[0] > -1e-6f);
    }
    for (int i = 0; i < 4; i++) CHECK(largest[i] > 20);
}

TEST(a_zero_quaternion_is_refused)
{
    dist_camera c = plain_camera(), before = c;
    const float zero[4] = {0, 0, 0, 0}, t[3] = {0, 0, 0};
    float bad[4] = {1, 0, 0, 0};
    uint32_t bits = 0x7f800000u;
    memcpy(bad + 2, &bits, sizeof bits);
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_camera_set_colmap(&c, zero, t));
    CHECK_EQUAL(DIST_NOT_FINITE, dist_camera_set_colmap(&c, bad, t));
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_camera_set_colmap(NULL, bad, t));
    CHECK_BYTES(sizeof c, &before, &c);
}

/* exp([w]x) by its series, in double. */
static void exponential(const double w[3], double e[9])
{
    double x[9] = {0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0}, term[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    memcpy(e, term, sizeof term);
    for (int n = 1; n < 60; n++) {
        double next[9];
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++)
                next[3 * i + j] = (term[3 * i] * x[j] + term[3 * i + 1] * x[3 + j] + term[3 * i + 2] * x[6 + j]) / n;
        memcpy(term, next, sizeof term);
        for (int i = 0; i < 9; i++) e[i] += term[i];
    }
}

TEST(move_is_the_exponential)
{
    test_random r = test_random_seed(8);
    const double sizes[9] = {0, 1e-9, 1e-6, 9e-5, 2e-4, 0.01, 1, 3.14159, 7};
    for (int k = 0; k < 90; k++) {
        dist_camera c = plain_camera();
        random_pose(&r, &c);
        dist_camera before = c;
        float u[3], w[3], t[3] = {0.5f, -0.25f, 2};
        double v[3], e[9];
        test_random_direction(&r, u);
        for (int i = 0; i < 3; i++) {
            w[i] = (float)(sizes[k % 9] * (double)u[i]);
            v[i] = (double)w[i];
        }
        exponential(v, e);
        dist_camera_move(&c, w, t);
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) {
                double expected = 0;
                for (int m = 0; m < 3; m++) expected += e[3 * i + m] * (double)before.rotation[3 * m + j];
                CHECK_NEAR(expected, c.rotation[3 * i + j], 3e-7);
            }
            CHECK_NEAR((double)before.translation[i] + (double)t[i], c.translation[i], 2.4e-7);
        }
    }
}

TEST(a_thousand_moves_stay_orthonormal)
{
    test_random r = test_random_seed(9);
    dist_camera c = plain_camera();
    for (int k = 0; k < 1000; k++) {
        float w[3];
        test_random_fill(&r, 3, w, -0.3f, 0.3f);
        dist_camera_move(&c, w, NULL);
    }
    CHECK(off_orthonormal(c.rotation) < 5e-7);
    CHECK_NEAR(1, determinant(c.rotation), 5e-7);
}

TEST(moves_there_and_back_return)
{
    dist_camera c = plain_camera(), before = c;
    const float w[3] = {0.3f, -0.2f, 0.5f}, back[3] = {-0.3f, 0.2f, -0.5f};
    for (int k = 0; k < 200; k++) {
        dist_camera_move(&c, w, NULL);
        dist_camera_move(&c, back, NULL);
    }
    CHECK_NEAR_ARRAY(9, before.rotation, c.rotation, 2e-5);
    dist_camera_move(&c, NULL, NULL);
    dist_camera_move(NULL, w, w);
    before = c;
    for (int k = 0; k < 6; k++) { /* what is not finite moves nothing, the rest of the step neither */
        float wrong[6] = {0.1f, 0.1f, 0.1f, 0.1f, 0.1f, 0.1f};
        wrong[k] = k & 1 ? INFINITY : NAN;
        dist_camera_move(&c, wrong, wrong + 3);
        CHECK(memcmp(&before, &c, sizeof c) == 0);
    }
    for (int k = 0; k < 3; k++) { /* nor does it leave float's range */
        const float far[3] = {2e38f, -2e38f, 1.0f};
        dist_camera_move(&c, NULL, far);
        for (int i = 0; i < 3; i++) CHECK(test_finite((double)c.translation[i]));
    }
}

/* Rows 28 to 30: what is refused, and that what is close enough is not. */
TEST(what_is_no_camera_is_refused_with_a_sentence)
{
    dist_context *ctx = test_context();
    float ball[4] = {0, 0, 0, 0.5f}, depth[64 * 48];
    dist_field field = dist_field_sphere(ball);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = depth;
    uint32_t nan_bits = 0x7fc00000u;
    float nan;
    memcpy(&nan, &nan_bits, sizeof nan);
    for (int k = 0; k < 22; k++) {
        dist_camera c = plain_camera();
        const char *part = "rotation";
        for (int i = 0; i < 9; i++) {
            if (k == 0) c.rotation[i] *= 1.01f;
            if (k == 1) c.rotation[i] = 0;
            if (k == 2) c.rotation[i] *= -1.0f;
            if (k == 3) c.rotation[i] *= 2.0f;
        }
        if (k == 4) c.rotation[0] *= -1.0f;
        if (k == 5) memcpy(c.rotation + 3, c.rotation, 3 * sizeof(float));
        if (k == 6) c.rotation[1] += 2e-3f;
        if (k == 7) c.rotation[4] = nan;
        if (k == 8) c.fx = 0, part = "camera.fx";
        if (k == 9) c.fy = 0, part = "fy";
        if (k == 10) c.fx = nan, part = "camera.fx";
        if (k == 11) c.fy = 1e-30f, part = "fy";
        if (k == 12) c.cx = nan, part = "camera.cx";
        if (k == 13) c.skew = nan, part = "skew";
        if (k == 14) c.translation[1] = nan, part = "translation";
        if (k == 15) c.width = 0, part = "0 x 48";
        if (k == 16) c.height = -5, part = "64 x -5";
        if (k == 17) c.width = 65537, part = "65537 x 48";
        if (k == 18) c.height = 2147483647, part = "65536";
        if (k == 19) c.pixel_center = nan, part = "pixel_center";
        if (k == 20) memset(&c, 0, sizeof c), part = "0 x 0";
        if (k == 21) c.cy = nan, part = "cy";
        dist_context_clear(ctx);
        CHECK(dist_render(ctx, &field, &c, NULL, &out, NULL) < 0);
        CHECK_TEXT("dist_render: camera", dist_context_message(ctx));
        CHECK_TEXT(part, dist_context_message(ctx));
        dist_context_clear(ctx);
        CHECK(dist_tape_create(ctx, &c, NULL) == NULL);
        CHECK_TEXT(part, dist_context_message(ctx));
    }
    dist_context_clear(ctx);
    dist_camera drifted = plain_camera();
    for (int i = 0; i < 9; i++) drifted.rotation[i] *= 1.0001f;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &drifted, NULL, &out, NULL), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, NULL, NULL, &out, NULL), ctx);
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(look_at_follows_its_formula);
    RUN(look_at_sees_x_right_y_down_z_forward);
    RUN(look_at_repairs_a_degenerate_view);
    RUN(look_at_of_garbage_gives_a_camera_that_render_refuses);
    RUN(rays_are_those_of_double);
    RUN(pixel_center_shifts_rays_by_half_a_pixel);
    RUN(opengl_goes_there_and_back);
    RUN(opengl_of_few_digits_stands_where_it_says);
    RUN(opengl_looks_along_minus_z_with_y_up);
    RUN(colmap_goes_there_and_back_in_every_branch);
    RUN(a_zero_quaternion_is_refused);
    RUN(move_is_the_exponential);
    RUN(a_thousand_moves_stay_orthonormal);
    RUN(moves_there_and_back_return);
    RUN(what_is_no_camera_is_refused_with_a_sentence);
    return test_report();
}
