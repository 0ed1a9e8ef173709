/* SPDX-License-Identifier: MIT-0
   The photometric loss: its value and its gradients against the formula in double, and what must not count; and the
   rasterizer of the examples' mesh baseline. */
#include "test.h"

#include "../examples/raster.h"

enum { W = 26, H = 22, PIXELS = W * H };

/* Two views of a tilted plane with a step, textured; part of the second view's depth is nearer: hidden there. */
typedef struct photo_case {
    float color_to[3 * PIXELS], color_from[3 * PIXELS], depth_to[PIXELS], depth_from[PIXELS];
    unsigned char mask_to[PIXELS], mask_from[PIXELS];
    dist_photo to, from;
} photo_case;

/* What has a kink: which pixels count, which cell of `from` they fall into, the signs of their residuals. */
typedef struct photo_kinks {
    int visible[PIXELS], cell[PIXELS], sign[3 * PIXELS];
} photo_kinks;

typedef struct photo_pose {
    double rotation[9], translation[3];
} photo_pose;

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static double plane_depth(const dist_camera *camera, double x, double y)
{
    inside_view view;
    double ray[3], world[3], normal[3] = {0.2, -0.1, 1.0};
    view = inside_view_of(camera);
    inside_view_direction(&view, x, y, ray);
    inside_rotate_back(view.rotation, ray, world);
    return -dot(normal, view.center) / dot(normal, world) * ray[2];
}

static void photo_fill(photo_case *c, uint64_t seed)
{
    test_random r = test_random_seed(seed);
    float eye[2][3] = {{0.3f, 0.2f, -2.5f}, {-0.15f, 0.35f, -2.4f}}, at[3] = {0, 0.05f, 0}, up[3] = {0, 1, 0};
    memset(c, 0, sizeof *c);
    c->to.camera = dist_camera_look_at(W, H, 0.8f, eye[0], at, up);
    c->from.camera = dist_camera_look_at(W, H, 0.85f, eye[1], at, up);
    c->from.camera.skew = 0.7f;
    c->from.camera.pixel_center = 0.5f;
    c->to.color = c->color_to;
    c->from.color = c->color_from;
    c->to.depth = c->depth_to;
    c->from.depth = c->depth_from;
    c->to.mask = c->mask_to;
    c->from.mask = c->mask_from;
    for (int i = 0; i < PIXELS; i++) {
        int x = i % W, y = i / W;
        c->depth_to[i] = (float)plane_depth(&c->to.camera, x, y) + test_random_float(&r, -0.02f, 0.02f);
        c->depth_from[i] = (float)plane_depth(&c->from.camera, x, y) - (x > 20 ? 0.5f : 0.0f);
        c->mask_to[i] = test_random_int(&r, 0, 12) > 0;
        c->mask_from[i] = test_random_int(&r, 0, 20) > 0;
        for (int k = 0; k < 3; k++) {
            c->color_to[3 * i + k] = test_random_float(&r, 0.0f, 1.0f);
            c->color_from[3 * i + k] = test_random_float(&r, 0.0f, 1.0f);
        }
    }
}

static photo_pose pose_of(const dist_camera *camera)
{
    inside_view view;
    photo_pose pose;
    view = inside_view_of(camera);
    memcpy(pose.rotation, view.rotation, sizeof pose.rotation);
    memcpy(pose.translation, view.translation, sizeof pose.translation);
    return pose;
}

/* R' = exp([w]x) R for a small turn around one axis, t' = t + d. */
static void pose_move(photo_pose *pose, int number, double by)
{
    if (number >= 3) {
        pose->translation[number - 3] += by;
        return;
    }
    int a = (number + 1) % 3, b = (number + 2) % 3;
    for (int j = 0; j < 3; j++) {
        double ra = pose->rotation[3 * a + j], rb = pose->rotation[3 * b + j];
        pose->rotation[3 * a + j] = cos(by) * ra - sin(by) * rb;
        pose->rotation[3 * b + j] = sin(by) * ra + cos(by) * rb;
    }
}

/* The loss by its formula, point by point through the world. poses: of `to` and of `from`. */
static double photo_reference(const photo_case *c, const double *depth, const photo_pose poses[2], double ssim,
                              double visibility, photo_kinks *kinks)
{
    const dist_camera *a = &c->to.camera, *b = &c->from.camera;
    static double warped[3 * PIXELS];
    double sum = 0, count = 0, windows = 0, window_count = 0;
    memset(kinks, 0, sizeof *kinks);
    for (int i = 0; i < PIXELS; i++) {
        double p[3], s[3], q[3], y = (i / W + (double)a->pixel_center - (double)a->cy) / (double)a->fy;
        double x = (i % W + (double)a->pixel_center - (double)a->cx - (double)a->skew * y) / (double)a->fx;
        double seen[3] = {x * depth[i], y * depth[i], depth[i]};
        if (!c->mask_to[i] || !(depth[i] > 0 && depth[i] < 1e5)) continue;
        for (int k = 0; k < 3; k++) s[k] = seen[k] - poses[0].translation[k];
        inside_rotate_back(poses[0].rotation, s, p);
        inside_rotate(poses[1].rotation, p, q);
        for (int k = 0; k < 3; k++) q[k] += poses[1].translation[k];
        if (q[2] <= 0) continue;
        double u = ((double)b->fx * q[0] + (double)b->skew * q[1]) / q[2] + (double)b->cx - (double)b->pixel_center;
        double v = (double)b->fy * q[1] / q[2] + (double)b->cy - (double)b->pixel_center;
        if (u < 0 || v < 0 || u > W - 1 || v > H - 1) continue;
        int left = (int)u < W - 1 ? (int)u : W - 2, top = (int)v < H - 1 ? (int)v : H - 2;
        double hits = 0, other = 0, color[3] = {0, 0, 0};
        for (int corner = 0; corner < 4; corner++) {
            int cx = left + corner % 2, cy = top + corner / 2;
            double share = (1 - fabs(u - cx)) * (1 - fabs(v - cy));
            for (int k = 0; k < 3; k++) color[k] += share * (double)c->color_from[3 * (cy * W + cx) + k];
            if (!c->mask_from[cy * W + cx]) continue;
            hits += share;
            other += share * (double)c->depth_from[cy * W + cx];
        }
        if (visibility >= 0 && !(hits > 0 && pow(q[2] - other / hits, 2) < visibility)) continue;
        kinks->visible[i] = 1;
        kinks->cell[i] = top * W + left;
        for (int k = 0; k < 3; k++) {
            warped[3 * i + k] = color[k];
            kinks->sign[3 * i + k] = color[k] > (double)c->color_to[3 * i + k];
            sum += fabs(color[k] - (double)c->color_to[3 * i + k]);
            count += 1;
        }
    }
    for (int i = 0; ssim > 0 && i < PIXELS; i++) {
        int all = i % W > 0 && i % W < W - 1 && i / W > 0 && i / W < H - 1;
        for (int k = 0; all && k < 9; k++) all = kinks->visible[i + (k / 3 - 1) * W + k % 3 - 1];
        for (int channel = 0; all && channel < 3; channel++) {
            double m[5] = {0, 0, 0, 0, 0};
            for (int k = 0; k < 9; k++) {
                int at = 3 * (i + (k / 3 - 1) * W + k % 3 - 1) + channel;
                double x = warped[at], y = (double)c->color_to[at];
                double term[5] = {x, y, x * x, y * y, x * y};
                for (int t = 0; t < 5; t++) m[t] += term[t] / 9;
            }
            windows += 0.5 - 0.5 * (2 * m[0] * m[1] + 1e-4) * (2 * (m[4] - m[0] * m[1]) + 9e-4) /
                                 ((m[0] * m[0] + m[1] * m[1] + 1e-4) *
                                  (m[2] - m[0] * m[0] + m[3] - m[1] * m[1] + 9e-4));
            window_count += 1;
        }
    }
    return (1 - ssim) * (count > 0 ? sum / count : 0) + ssim * (window_count > 0 ? windows / window_count : 0);
}

typedef struct photo_setting {
    float ssim, visibility;
} photo_setting;
static const photo_setting photo_settings[] = {{0, 0}, {0, -1}, {0.5f, 0}, {1, 0.01f}};

static dist_photometric_desc photo_desc(const photo_setting *s)
{
    dist_photometric_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.ssim = s->ssim;
    desc.visibility = s->visibility;
    return desc;
}

static double photo_visibility(const photo_setting *s)
{
    return s->visibility < 0 || s->visibility > 0 ? (double)s->visibility : 1e-3;
}

static void photo_start(const photo_case *c, double *depth, photo_pose poses[2])
{
    for (int i = 0; i < PIXELS; i++) depth[i] = (double)c->depth_to[i];
    poses[0] = pose_of(&c->to.camera);
    poses[1] = pose_of(&c->from.camera);
}

TEST(photometric_loss_is_its_formula)
{
    static photo_case c;
    static photo_kinks kinks;
    double depth[PIXELS];
    photo_pose poses[2];
    for (size_t s = 0; s < 4; s++) {
        photo_fill(&c, 3 + s);
        photo_start(&c, depth, poses);
        static unsigned char visible[PIXELS];
        dist_photometric_desc desc = photo_desc(&photo_settings[s]);
        desc.visible = visible;
        double visibility = photo_visibility(&photo_settings[s]);
        double expected = photo_reference(&c, depth, poses, (double)desc.ssim, visibility, &kinks);
        CHECK_NEAR(2.5 * expected, dist_loss_photometric(&c.to, &c.from, &desc, 2.5f, NULL, NULL), 1e-6);
        int count = 0;
        for (int i = 0; i < PIXELS; i++) {
            CHECK_EQUAL(kinks.visible[i], visible[i]);
            count += visible[i];
        }
        CHECK(count > PIXELS / 3 && count < PIXELS * 95 / 100);
    }
}

/* Depth of every pixel; pixels that meet a kink within 10 h (the set that counts, a cell of the bilinear picture, a
   sign) are left out and counted. */
TEST(photometric_depth_gradient_is_the_central_difference)
{
    static photo_case c;
    static photo_kinks low, high;
    static float d_depth[PIXELS];
    double depth[PIXELS], h = 1e-6;
    photo_pose poses[2];
    for (size_t s = 0; s < 4; s++) {
        photo_fill(&c, 11 + s);
        photo_start(&c, depth, poses);
        dist_photometric_desc desc = photo_desc(&photo_settings[s]);
        double ssim = (double)desc.ssim, visibility = photo_visibility(&photo_settings[s]);
        for (int i = 0; i < PIXELS; i++) d_depth[i] = 0.25f;
        dist_loss_photometric(&c.to, &c.from, &desc, 2.5f, d_depth, NULL);
        size_t excluded = 0, moved = 0;
        for (int i = 0; i < PIXELS; i += test_quick() ? 7 : 1) {
            double middle = depth[i];
            depth[i] = middle - 10 * h;
            photo_reference(&c, depth, poses, ssim, visibility, &low);
            depth[i] = middle + 10 * h;
            photo_reference(&c, depth, poses, ssim, visibility, &high);
            depth[i] = middle + h;
            double up = photo_reference(&c, depth, poses, ssim, visibility, &high);
            depth[i] = middle - h;
            double down = photo_reference(&c, depth, poses, ssim, visibility, &low);
            depth[i] = middle;
            if (memcmp(&low, &high, sizeof low)) {
                excluded++;
                continue;
            }
            moved += fabs(up - down) > 0;
            CHECK_NEAR(2.5 * (up - down) / (2 * h), d_depth[i] - 0.25f, 1e-6);
        }
        CHECK(excluded * 100 < PIXELS);
        CHECK(moved > (test_quick() ? 20 : 200));
    }
}

TEST(photometric_camera_gradients_are_central_differences)
{
    static photo_case c;
    static photo_kinks low, high;
    double depth[PIXELS], h = 1e-7;
    photo_pose poses[2];
    size_t excluded = 0;
    for (size_t s = 0; s < 4; s++) {
        photo_fill(&c, 31 + s);
        photo_start(&c, depth, poses);
        dist_photometric_desc desc = photo_desc(&photo_settings[s]);
        double ssim = (double)desc.ssim, visibility = photo_visibility(&photo_settings[s]);
        float d_cameras[12];
        for (int k = 0; k < 12; k++) d_cameras[k] = 1.0f;
        dist_loss_photometric(&c.to, &c.from, &desc, 1.0f, NULL, d_cameras);
        for (int k = 0; k < 12; k++) {
            photo_pose moved[2] = {poses[0], poses[1]};
            pose_move(&moved[k / 6], k % 6, h);
            double up = photo_reference(&c, depth, moved, ssim, visibility, &high);
            pose_move(&moved[k / 6], k % 6, -2 * h);
            double down = photo_reference(&c, depth, moved, ssim, visibility, &low);
            if (memcmp(&low, &high, sizeof low)) {
                excluded++;
                continue;
            }
            CHECK_NEAR((up - down) / (2 * h), d_cameras[k] - 1.0f, 1e-6 * (1 + fabs((up - down) / h)));
        }
    }
    CHECK(excluded * 10 <= 48);
}

/* A color that depends on the place on the surface only, so that the true depth explains both photos. */
static void paint(const float p[3], float color[3])
{
    color[0] = 0.5f + 0.3f * sinf(5.0f * p[0] + 2.0f * p[1]);
    color[1] = 0.5f + 0.3f * sinf(4.0f * p[1] - 3.0f * p[2]);
    color[2] = 0.5f + 0.3f * cosf(6.0f * p[2] + p[0]);
}

enum { SPHERE_SIDE = 48, SPHERE_PIXELS = SPHERE_SIDE * SPHERE_SIDE };
typedef struct sphere_pair {
    dist_context *ctx;
    dist_tape *tape;
    dist_camera camera[2];
    float depth[2][SPHERE_PIXELS], color[2][3 * SPHERE_PIXELS];
    unsigned char mask[2][SPHERE_PIXELS], inner[SPHERE_PIXELS];
} sphere_pair;

static void sphere_render(sphere_pair *s, const float *numbers, int view, int tape)
{
    dist_field field = dist_field_sphere(numbers);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = s->depth[view];
    out.mask = s->mask[view];
    CHECK_STATUS(DIST_OK, dist_render(s->ctx, &field, &s->camera[view], NULL, &out, tape ? s->tape : NULL), s->ctx);
}

/* Photos of a painted sphere from two sides; inner: hits whose distance to the outline is some pixels. */
static void sphere_photos(sphere_pair *s, const float *numbers)
{
    float eye[2][3] = {{0.2f, 0.3f, 2.4f}, {0.8f, 0.2f, 2.3f}}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    memset(s, 0, sizeof *s);
    s->ctx = test_context();
    for (int v = 0; v < 2; v++) {
        s->camera[v] = dist_camera_look_at(SPHERE_SIDE, SPHERE_SIDE, 0.8f, eye[v], at, up);
        if (v == 0) s->tape = dist_tape_create(s->ctx, &s->camera[0], NULL);
        sphere_render(s, numbers, v, 0);
        for (int i = 0; i < SPHERE_PIXELS; i++) {
            float o[3], d[3], p[3];
            dist_camera_ray(&s->camera[v], (float)(i % SPHERE_SIDE), (float)(i / SPHERE_SIDE), o, d);
            float along = 0;
            for (int k = 0; k < 3; k++) along += d[k] * s->camera[v].rotation[6 + k];
            for (int k = 0; k < 3; k++) p[k] = o[k] + d[k] * s->depth[v][i] / along;
            if (s->mask[v][i]) paint(p, s->color[v] + 3 * i);
        }
    }
    for (int i = 3 * SPHERE_SIDE + 3; i < SPHERE_PIXELS - 3 * SPHERE_SIDE - 3; i++) {
        s->inner[i] = 1;
        for (int k = 0; k < 49; k++) s->inner[i] &= s->mask[0][i + (k / 7 - 3) * SPHERE_SIDE + k % 7 - 3];
    }
}

static float sphere_loss(const sphere_pair *s, float *d_depth, float *d_cameras)
{
    dist_photo to, from;
    memset(&to, 0, sizeof to);
    memset(&from, 0, sizeof from);
    to.color = s->color[0];
    to.depth = s->depth[0];
    to.mask = s->inner;
    to.camera = s->camera[0];
    from.color = s->color[1];
    from.camera = s->camera[1];
    from.depth = s->depth[1];
    from.mask = s->mask[1];
    return dist_loss_photometric(&to, &from, NULL, 1.0f, d_depth, d_cameras);
}

TEST(photometric_loss_is_small_at_the_true_shape)
{
    static sphere_pair s;
    float truth[4] = {0.05f, 0, 0, 0.6f}, wrong[4] = {0.05f, 0, 0, 0.55f};
    sphere_photos(&s, truth);
    float right = sphere_loss(&s, NULL, NULL);
    sphere_render(&s, wrong, 0, 0);
    sphere_render(&s, wrong, 1, 0);
    float off = sphere_loss(&s, NULL, NULL);
    CHECK(right > 0.0f && right < 0.01f);
    CHECK(off > 5.0f * right);
    dist_tape_destroy(s.tape);
    dist_context_destroy(s.ctx);
}

/* From the loss through the depth to the code, and to the camera on both its ways: of the depth and of the warp. The
   difference is taken by rendering again, so its step is large and the agreement that of float. */
TEST(photometric_gradient_reaches_code_and_cameras)
{
    static sphere_pair s;
    static float d_depth[SPHERE_PIXELS];
    float truth[4] = {0.05f, 0, 0, 0.6f}, numbers[4] = {0.03f, 0.02f, -0.01f, 0.57f};
    float d_code[4] = {0, 0, 0, 0}, d_cameras[12];
    sphere_photos(&s, truth);
    sphere_render(&s, numbers, 1, 0);
    sphere_render(&s, numbers, 0, 1);
    memset(d_depth, 0, sizeof d_depth);
    memset(d_cameras, 0, sizeof d_cameras);
    sphere_loss(&s, d_depth, d_cameras);
    dist_images d_out;
    dist_gradients grads;
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    d_out.depth = d_depth;
    grads.code = d_code;
    grads.rotation = d_cameras;
    grads.translation = d_cameras + 3;
    CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, s.tape, &d_out, &grads), s.ctx);
    float h = 5e-4f, largest = 0;
    for (int k = 0; k < 10; k++) largest = fmaxf(largest, fabsf(k < 4 ? d_code[k] : d_cameras[k - 4]));
    for (int k = 0; k < 10; k++) {
        float value[2];
        dist_camera before = s.camera[0];
        for (int side = 0; side < 2; side++) {
            float moved[4], w[3] = {0, 0, 0}, t[3] = {0, 0, 0}, step = side ? h : -h;
            memcpy(moved, numbers, sizeof moved);
            if (k < 4) moved[k] += step;
            if (k >= 4 && k < 7) w[k - 4] = step;
            if (k >= 7) t[k - 7] = step;
            dist_camera_move(&s.camera[0], w, t);
            sphere_render(&s, moved, 0, 0);
            value[side] = sphere_loss(&s, NULL, NULL);
            s.camera[0] = before;
        }
        CHECK_NEAR((value[1] - value[0]) / (2 * h), k < 4 ? d_code[k] : d_cameras[k - 4], 0.02 * (double)largest);
    }
    dist_tape_destroy(s.tape);
    dist_context_destroy(s.ctx);
}

/* The same through a placed shape: its code and the seven numbers of its similarity. */
TEST(photometric_gradient_reaches_a_similarity)
{
    static sphere_pair s;
    static float d_depth[SPHERE_PIXELS];
    float truth[4] = {0.05f, 0, 0, 0.6f}, numbers[4] = {0.1f, 0.15f, -0.1f, 0.5f}, d_code[11], h = 5e-4f, largest = 0;
    memset(d_code, 0, sizeof d_code);
    memset(d_depth, 0, sizeof d_depth);
    sphere_photos(&s, truth);
    dist_field field = dist_field_sphere(numbers);
    dist_instance instance;
    memset(&instance, 0, sizeof instance);
    instance.field = &field;
    instance.placement.scale = 1.15f;
    instance.placement.translation[0] = -0.07f;
    instance.placement.translation[1] = -0.15f;
    instance.placement.translation[2] = 0.1f;
    dist_scene *scene = dist_scene_create(s.ctx, 1, &instance);
    REQUIRE(scene);
    CHECK_EQUAL(11, dist_scene_offset(scene, 1));
    for (int k = -1; k < 11; k++) {
        float value[2] = {0, 0}, kept[4];
        memcpy(kept, numbers, sizeof kept);
        for (int side = 0; side < (k < 0 ? 1 : 2); side++) {
            dist_instance moved = instance;
            float step[7] = {0, 0, 0, 0, 0, 0, 0};
            if (k >= 4) step[k - 4] = side ? h : -h;
            if (k >= 0 && k < 4) numbers[k] += side ? h : -h;
            dist_similarity_move(&moved.placement, step);
            CHECK_STATUS(DIST_OK, dist_scene_set(scene, 0, &moved), s.ctx);
            dist_field placed = dist_scene_field(scene);
            dist_images out, d_out;
            memset(&out, 0, sizeof out);
            memset(&d_out, 0, sizeof d_out);
            for (int view = k < 0 ? 1 : 0; view >= 0; view--) { /* the other view's depth stays that of the middle */
                out.depth = s.depth[view];
                out.mask = s.mask[view];
                CHECK_STATUS(DIST_OK, dist_render(s.ctx, &placed, &s.camera[view], NULL, &out, view ? NULL : s.tape),
                             s.ctx);
            }
            value[side] = sphere_loss(&s, k < 0 ? d_depth : NULL, NULL);
            memcpy(numbers, kept, sizeof kept);
            if (k >= 0) continue;
            dist_gradients grads;
            memset(&grads, 0, sizeof grads);
            grads.code = d_code;
            d_out.depth = d_depth;
            CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, s.tape, &d_out, &grads), s.ctx);
            for (int j = 0; j < 11; j++) largest = fmaxf(largest, fabsf(d_code[j]));
        }
        if (k >= 0) CHECK_NEAR((value[1] - value[0]) / (2 * h), d_code[k], 0.02 * (double)largest);
    }
    CHECK(largest > 0.05f);
    dist_scene_destroy(scene);
    dist_tape_destroy(s.tape);
    dist_context_destroy(s.ctx);
}

/* Behind the other camera, outside its picture, a depth that is no depth, a color that is no number. */
TEST(what_the_other_view_cannot_see_does_not_count)
{
    static photo_case c;
    static float d_depth[PIXELS], warped[3 * PIXELS];
    static unsigned char visible[PIXELS];
    uint32_t bits = 0x7fc00000u;
    float nan;
    memcpy(&nan, &bits, sizeof nan);
    dist_photometric_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.visible = visible;
    desc.warped = warped;
    for (int kind = 0; kind < 5; kind++) {
        photo_fill(&c, 50);
        if (kind == 0) c.from.camera.translation[2] -= 50.0f;
        if (kind == 1) c.from.camera.translation[0] += 50.0f;
        for (int i = 0; i < PIXELS; i++) {
            if (kind == 2) c.depth_to[i] = i % 3 == 0 ? nan : i % 3 == 1 ? 1e11f : -1.0f;
            if (kind == 3) c.color_to[3 * i + 1] = nan;
            if (kind == 4) c.color_from[3 * i + 2] = nan;
        }
        for (int i = 0; i < PIXELS; i++) d_depth[i] = 7.0f;
        float d_cameras[12] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
        CHECK_NEAR(0, dist_loss_photometric(&c.to, &c.from, &desc, 1.0f, d_depth, d_cameras), 0);
        for (int i = 0; i < PIXELS; i++) {
            CHECK_EQUAL(0, visible[i]);
            CHECK_NEAR(7, d_depth[i], 0);
            CHECK_NEAR(0, warped[3 * i], 0);
        }
        for (int k = 0; k < 12; k++) CHECK_NEAR(0, d_cameras[k], 0);
    }
}

TEST(photometric_loss_of_bad_arguments_is_zero)
{
    static photo_case c;
    static float d_depth[PIXELS];
    dist_photometric_desc desc;
    memset(&desc, 0, sizeof desc);
    photo_fill(&c, 60);
    CHECK(dist_loss_photometric(&c.to, &c.from, &desc, 1.0f, NULL, NULL) > 0);
    CHECK_NEAR(0, dist_loss_photometric(&c.to, &c.from, &desc, (float)NAN, d_depth, NULL), 0);
    CHECK_NEAR(0, dist_loss_photometric(NULL, &c.from, NULL, 1.0f, d_depth, NULL), 0);
    CHECK_NEAR(0, dist_loss_photometric(&c.to, NULL, NULL, 1.0f, d_depth, NULL), 0);
    uint32_t bits = 0x7fc00000u;
    memcpy(&desc.visibility, &bits, sizeof bits);
    CHECK_NEAR(0, dist_loss_photometric(&c.to, &c.from, &desc, 1.0f, d_depth, NULL), 0);
    desc.visibility = 0.0f;
    desc.ssim = 1.5f;
    CHECK_NEAR(0, dist_loss_photometric(&c.to, &c.from, &desc, 1.0f, d_depth, NULL), 0);
    c.from.camera.rotation[0] = 5.0f;
    CHECK_NEAR(0, dist_loss_photometric(&c.to, &c.from, NULL, 1.0f, d_depth, NULL), 0);
    for (int i = 0; i < PIXELS; i++) CHECK_NEAR(0, d_depth[i], 0);
}

/* One pixel wide or high, and a photo of another size than the view it is warped into. */
TEST(photos_may_differ_in_size_and_be_one_pixel_wide)
{
    static photo_case c;
    static float big[3 * 64 * 48], d_depth[PIXELS];
    photo_fill(&c, 70);
    for (int i = 0; i < 3 * 64 * 48; i++) big[i] = 0.5f;
    dist_photo big_photo = c.from;
    big_photo.color = big;
    big_photo.depth = NULL;
    big_photo.mask = NULL;
    big_photo.camera.width = 64;
    big_photo.camera.height = 48;
    CHECK(dist_loss_photometric(&c.to, &big_photo, NULL, 1.0f, d_depth, NULL) > 0);
    for (int i = 0; i < PIXELS; i++) CHECK_NEAR(0, d_depth[i], 0);
    dist_photo thin = c.to;
    thin.camera.width = 1;
    CHECK(dist_loss_photometric(&thin, &big_photo, NULL, 1.0f, NULL, NULL) > 0);
    big_photo.camera.width = big_photo.camera.height = 1;
    big_photo.camera.cx = big_photo.camera.cy = 0.0f;
    CHECK(dist_loss_photometric(&c.to, &big_photo, NULL, 1.0f, d_depth, NULL) >= 0);
}

/* Also at its border, where rounding may put a pixel outside. */
TEST(a_photo_sees_all_of_itself)
{
    static photo_case c;
    static unsigned char visible[PIXELS];
    test_random random = test_random_seed(11);
    photo_fill(&c, 71);
    for (int pose = 0; pose < 100; pose++) {
        float move[6];
        dist_photometric_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.visible = visible;
        test_random_fill(&random, 6, move, -0.1f, 0.1f);
        dist_camera_move(&c.to.camera, move, move + 3);
        CHECK_NEAR(0, dist_loss_photometric(&c.to, &c.to, &desc, 1.0f, NULL, NULL), 1e-6);
        CHECK(memcmp(c.mask_to, visible, sizeof visible) == 0);
    }
}

/* The baseline of fit_photos: depth of a mesh in place of the rays'. */
TEST(raster_depth_of_a_mesh_is_that_of_the_rays)
{
    static sphere_pair s;
    static float depth[SPHERE_PIXELS];
    static unsigned char mask[SPHERE_PIXELS];
    static unsigned triangle[SPHERE_PIXELS];
    float numbers[4] = {0.05f, -0.1f, 0, 0.6f};
    sphere_photos(&s, numbers);
    dist_field field = dist_field_sphere(numbers);
    dist_mesh_desc how;
    memset(&how, 0, sizeof how);
    how.resolution = 64;
    how.refine = 1;
    dist_mesh *mesh = dist_mesh_extract(s.ctx, &field, &how);
    REQUIRE(mesh);
    raster_depth(&s.camera[0], mesh, depth, mask, triangle);
    int inner = 0;
    for (int i = 0; i < SPHERE_PIXELS; i++) {
        if (!s.inner[i]) continue;
        inner++;
        CHECK_EQUAL(1, mask[i]);
        CHECK(triangle[i] > 0);
        CHECK_NEAR(s.depth[0][i], depth[i], 1e-3);
    }
    CHECK(inner > SPHERE_PIXELS / 8);

    /* and so is the gradient that the same change of depth gives the code, once by the mesh and once by the rays */
    static float d_depth[SPHERE_PIXELS];
    float by_mesh[4] = {0, 0, 0, 0}, by_rays[4] = {0, 0, 0, 0};
    for (int i = 0; i < SPHERE_PIXELS; i++) d_depth[i] = s.inner[i] ? 1.0f + 0.03f * (float)(i % SPHERE_SIDE) : 0.0f;
    float *d_vertices = (float *)calloc(3 * mesh->vertex_count, sizeof(float));
    REQUIRE(d_vertices);
    raster_backward(&s.camera[0], mesh, triangle, d_depth, d_vertices);
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = by_mesh;
    CHECK_STATUS(DIST_OK, dist_mesh_backward(s.ctx, &field, mesh, d_vertices, &grads), s.ctx);
    sphere_render(&s, numbers, 0, 1);
    dist_images d_out;
    memset(&d_out, 0, sizeof d_out);
    d_out.depth = d_depth;
    grads.code = by_rays;
    CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, s.tape, &d_out, &grads), s.ctx);
    for (int k = 0; k < 4; k++) CHECK_NEAR(by_rays[k], by_mesh[k], 0.02 * fabs((double)by_rays[3]));
    free(d_vertices);
    dist_mesh_destroy(mesh);
    dist_tape_destroy(s.tape);
    dist_context_destroy(s.ctx);
}

/* One corner of four moves; pixels that change their triangle meanwhile have a kink and are left out and counted. */
TEST(raster_gradient_is_the_central_difference_of_its_depth)
{
    static float depth[2][PIXELS], d_depth[PIXELS];
    static unsigned char mask[PIXELS];
    static unsigned triangle[3][PIXELS];
    dist_context *ctx = test_context();
    float vertices[12] = {-1.1f, -0.9f, 0.1f, 1.2f, -1.0f, -0.3f, 1.0f, 0.9f, 0.2f, -1.0f, 1.1f, -0.4f};
    float eye[3] = {0.4f, 0.3f, -3.0f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    unsigned faces[6] = {0, 1, 2, 0, 2, 3};
    dist_camera camera = dist_camera_look_at(W, H, 0.8f, eye, at, up);
    dist_mesh *mesh = dist_mesh_create(ctx, 4, vertices, 2, faces);
    REQUIRE(mesh);
    camera.skew = 1.5f;
    test_random r = test_random_seed(5);
    raster_depth(&camera, mesh, depth[0], mask, triangle[0]);
    for (size_t j = 0; j < 12; j++) {
        float d_vertices[12] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0}, h = 1e-3f;
        for (int side = 0; side < 2; side++) {
            mesh->vertices[j] = vertices[j] + (side ? h : -h);
            raster_depth(&camera, mesh, depth[side], mask, triangle[1 + side]);
        }
        mesh->vertices[j] = vertices[j];
        int excluded = 0, covered = 0;
        double change = 0;
        for (size_t i = 0; i < PIXELS; i++) {
            int kink = triangle[1][i] != triangle[0][i] || triangle[2][i] != triangle[0][i];
            d_depth[i] = kink ? 0.0f : test_random_float(&r, 0, 1);
            covered += triangle[0][i] > 0;
            excluded += kink;
            change += (double)d_depth[i] * ((double)depth[1][i] - (double)depth[0][i]) / (2 * (double)h);
        }
        raster_backward(&camera, mesh, triangle[0], d_depth, d_vertices);
        CHECK_NEAR(change, d_vertices[j], 1e-3 * (1 + fabs(change)));
        CHECK(covered > PIXELS / 3 && excluded * 10 < covered);
    }
    dist_mesh_destroy(mesh);
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(photometric_loss_is_its_formula);
    RUN(photometric_depth_gradient_is_the_central_difference);
    RUN(photometric_camera_gradients_are_central_differences);
    RUN(photometric_loss_is_small_at_the_true_shape);
    RUN(photometric_gradient_reaches_code_and_cameras);
    RUN(photometric_gradient_reaches_a_similarity);
    RUN(what_the_other_view_cannot_see_does_not_count);
    RUN(photometric_loss_of_bad_arguments_is_zero);
    RUN(photos_may_differ_in_size_and_be_one_pixel_wide);
    RUN(a_photo_sees_all_of_itself);
    RUN(raster_depth_of_a_mesh_is_that_of_the_rays);
    RUN(raster_gradient_is_the_central_difference_of_its_depth);
    return test_report();
}
