/* SPDX-License-Identifier: MIT-0
   test_outline.c - the relaxed boundary: how a loss on color alone, without a mask, moves an outline */
#include "test.h"

enum { SIDE = 128, PIXELS = SIDE * SIDE };

static const float paint[3] = {0.9f, 0.4f, 0.1f};
static const float sky[3] = {0.1f, 0.3f, 0.8f};

/* One color everywhere: nothing but the outline tells where the shape is. */
static void flat_color(void *user, int worker, size_t n, const float *points, float *color)
{
    (void)user, (void)worker, (void)points;
    for (size_t i = 0; i < n; i++) memcpy(color + 3 * i, paint, sizeof paint);
}

static void flat_color_adjoint(void *user, int worker, size_t n, const float *points, const float *d_color,
                               float *d_points, double *d_code, double *d_color_code)
{
    (void)user, (void)worker, (void)n, (void)points, (void)d_color, (void)d_points, (void)d_code, (void)d_color_code;
}

static dist_field flat_sphere(const float *code)
{
    dist_field field = dist_field_sphere(code);
    memset(field.center, 0, sizeof field.center);
    field.radius = 1.0f;
    field.color_fn = flat_color;
    field.color_adjoint_fn = flat_color_adjoint;
    return field;
}

static dist_camera camera_at(int side, double turn)
{
    float eye[3] = {(float)(2.4 * sin(turn)), 0.7f, (float)(2.4 * cos(turn))}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    return dist_camera_look_at(side, side, 0.8f, eye, at, up);
}

/* A pixel's width at the shape's distance. */
static float pixel_width(const dist_camera *camera)
{
    return 2.5f / camera->fx;
}

static dist_render_desc outline_how(float band)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.relax_band = band;
    memcpy(how.background_color, sky, sizeof sky);
    how.background = 5.0f;
    return how;
}

typedef struct result {
    float code[4], rotation[3], translation[3], focal[2], principal[2];
    dist_gradients grads;
} result;

static void result_begin(result *r)
{
    memset(r, 0, sizeof *r);
    r->grads.code = r->code;
    r->grads.rotation = r->rotation;
    r->grads.translation = r->translation;
    r->grads.focal = r->focal;
    r->grads.principal = r->principal;
}

/* The smallest distance from the sphere along a pixel's ray, and where; places between pixels are welcome. */
static double least_of(const double code[4], const inside_view *view, double x, double y, double p[3])
{
    double local[3], v[3], o[3], along = 0.0;
    inside_view_direction(view, x, y, local);
    inside_rotate_back(view->rotation, local, v);
    for (int k = 0; k < 3; k++) along -= (view->center[k] - code[k]) * v[k];
    for (int k = 0; k < 3; k++) {
        p[k] = view->center[k] + along * v[k];
        o[k] = p[k] - code[k];
    }
    return sqrt(o[0] * o[0] + o[1] * o[1] + o[2] * o[2]) - code[3];
}

/* A weight that differs from place to place, so that every number of the code counts. */
static double weight_at(double x, double y, int side)
{
    return 0.5 + x / side - 0.4 * y / side;
}

/* Renders a sphere with a tape and sends weight_at back as the upstream gradient of red. */
static dist_tape *outline_backward(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                                   const dist_render_desc *how, result *r)
{
    size_t n = (size_t)camera->width * (size_t)camera->height;
    float *color = (float *)malloc(3 * n * sizeof(float)), *d_color = (float *)calloc(3 * n, sizeof(float));
    dist_images out, d_out;
    if (!color || !d_color) exit(1);
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    out.color = color;
    d_out.color = d_color;
    for (size_t i = 0; i < n; i++) {
        d_color[3 * i] = (float)weight_at((double)(i % (size_t)camera->width), (double)(i / (size_t)camera->width),
                                          camera->width);
    }
    dist_tape *tape = dist_tape_create(ctx, camera, how);
    CHECK_STATUS(DIST_OK, dist_render(ctx, field, camera, how, &out, tape), ctx);
    result_begin(r);
    CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &r->grads), ctx);
    free(color);
    free(d_color);
    return tape;
}

/* Every seed is d_c (c_out - c_in) / band at the sample of smallest f, in double; d_c, here linear over the picture,
   where the sphere's point next to the sample is seen. Hits give nothing: their color does not change. */
TEST(outline_seeds_are_what_the_equation_says)
{
    for (int paper = 0; paper < 2; paper++) {
        float code[4] = {0.1f, -0.05f, 0.05f, 0.6f};
        double expected[4] = {0, 0, 0, 0}, pull[3] = {0, 0, 0}, turned[3];
        dist_context *ctx = test_context();
        dist_field field = flat_sphere(code);
        dist_camera camera = camera_at(SIDE, 0.4);
        dist_render_desc how = outline_how(2.0f * pixel_width(&camera));
        how.trace = paper ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        inside_view view;
        result got;
        int near_misses = 0;
        view = inside_view_of(&camera);
        dist_tape *tape = outline_backward(ctx, &field, &camera, &how, &got);
        inside_tape kept = inside_tape_of(tape);
        for (int i = 0; i < PIXELS; i++) {
            double p[3], local[3], v[3], n[3], q[3], length = 0.0, t = 0.0;
            inside_view_direction(&view, i % SIDE, i / SIDE, local);
            inside_rotate_back(view.rotation, local, v);
            if (!inside_tape_missed(tape, (size_t)i)) continue;
            for (int k = 0; k < 3; k++) t -= view.center[k] * v[k];
            for (int k = 0; k < 3; k++) {
                p[k] = paper ? (double)kept.sample[4 * i + 1 + k] : view.center[k] + (t + (double)kept.s[i]) * v[k];
                n[k] = p[k] - (double)code[k];
                length += n[k] * n[k];
            }
            length = sqrt(length);
            if (length <= (double)code[3] || length - (double)code[3] >= (double)how.relax_band) continue;
            near_misses++;
            for (int k = 0; k < 3; k++) {
                n[k] /= length;
                p[k] = (double)code[k] + (double)code[3] * n[k];
            }
            inside_rotate(view.rotation, p, q);
            for (int k = 0; k < 3; k++) q[k] += view.translation[k];
            double seed = weight_at(view.fx * q[0] / q[2] + view.cx, view.fy * q[1] / q[2] + view.cy, SIDE) *
                          (double)(sky[0] - paint[0]) / (double)how.relax_band;
            for (int k = 0; k < 3; k++) {
                expected[k] -= seed * n[k];
                pull[k] += seed * n[k];
            }
            expected[3] -= seed;
        }
        CHECK(near_misses > 200);
        double size = fabs(expected[3]);
        for (int k = 0; k < 4; k++) CHECK_NEAR(expected[k], got.code[k], 1e-4 * size);
        inside_rotate(view.rotation, pull, turned);
        for (int k = 0; k < 3; k++) CHECK_NEAR(-turned[k], got.translation[k], 1e-4 * size);
        dist_tape_destroy(tape);
        dist_context_destroy(ctx);
    }
}

/* Sum of weight x red over a picture of infinitely small pixels, per pixel of the given one. */
static double covered(const double code[4], const inside_view *view, int side)
{
    enum { FINE = 6 };
    double sum = 0.0, p[3];
    for (int y = 0; y < FINE * side; y++)
        for (int x = 0; x < FINE * side; x++) {
            double u = (x + 0.5) / FINE - 0.5, v = (y + 0.5) / FINE - 0.5;
            double red = least_of(code, view, u, v, p) < 0.0 ? (double)paint[0] : (double)sky[0];
            sum += red * weight_at(u, v, side) / (FINE * FINE);
        }
    return sum;
}

/* The relaxed gradient is the derivative of the covered area's color but for the band's width: of the order of band
   over radius, and less with more pixels. */
TEST(outline_gradient_is_the_derivative_of_the_area_but_for_the_bands_width)
{
    const double h = 0.02;
    double errors[2];
    for (int fine = 0; fine < 2; fine++) {
        int side = fine ? SIDE : SIDE / 4;
        float code[4] = {0.1f, -0.05f, 0.05f, 0.6f};
        dist_context *ctx = test_context();
        dist_field field = flat_sphere(code);
        dist_camera camera = camera_at(side, 0.4);
        dist_render_desc how = outline_how(pixel_width(&camera));
        inside_view view;
        result got;
        double size = 0.0, worst = 0.0;
        view = inside_view_of(&camera);
        dist_tape_destroy(outline_backward(ctx, &field, &camera, &how, &got));
        for (int group = 0; group < 2; group++)
            for (int k = 0; k < (group ? 3 : 4); k++) { /* the code, the camera's translation */
                double sides[2], minus[3];
                for (int side_of = 0; side_of < 2; side_of++) {
                    inside_view moved = view;
                    double exact[4], step = side_of ? h : -h;
                    for (int j = 0; j < 4; j++) exact[j] = (double)code[j] + (!group && j == k ? step : 0.0);
                    if (group) moved.translation[k] += step;
                    for (int j = 0; j < 3; j++) minus[j] = -moved.translation[j];
                    inside_rotate_back(moved.rotation, minus, moved.center);
                    sides[side_of] = covered(exact, &moved, side);
                }
                double expected = (sides[1] - sides[0]) / (2.0 * h);
                size = fmax(size, fabs(expected));
                worst = fmax(worst, fabs(expected - (double)(group ? got.translation[k] : got.code[k])));
                if (test_state.verbose)
                    printf("    %d pixels, %s %d: %.4g, relaxed %.4g\n", side, group ? "translation" : "code", k,
                           expected, (double)(group ? got.translation[k] : got.code[k]));
            }
        errors[fine] = worst / size;
        dist_context_destroy(ctx);
    }
    if (test_state.verbose) printf("    errors %.4f, %.4f\n", errors[0], errors[1]);
    CHECK(errors[1] < 0.04);
    CHECK(errors[1] < 0.6 * errors[0]);
}

/* From two photos in which only the color differs, compared without a mask. Without the band nothing moves. */
TEST(a_sphere_is_found_by_its_color_alone)
{
    enum { SMALL = 48, N = SMALL * SMALL, STEPS = 150 };
    static float photo[2][3 * N], color[3 * N], d_color[3 * N];
    for (int relaxed = 0; relaxed < 2; relaxed++) {
        float truth[4] = {0.1f, -0.05f, 0.05f, 0.5f}, code[4] = {-0.08f, 0.1f, -0.05f, 0.38f}, moments[8] = {0};
        dist_context *ctx = test_context();
        dist_field real = flat_sphere(truth), field = flat_sphere(code);
        dist_camera cameras[2] = {camera_at(SMALL, 0.0), camera_at(SMALL, 1.3)};
        dist_render_desc how = outline_how(relaxed ? 1.5f * pixel_width(&cameras[0]) : 0.0f);
        dist_images out, d_out;
        dist_adam adam;
        dist_tape *tapes[2];
        memset(&out, 0, sizeof out);
        memset(&d_out, 0, sizeof d_out);
        memset(&adam, 0, sizeof adam);
        adam.moments = moments;
        for (int v = 0; v < 2; v++) {
            out.color = photo[v];
            CHECK_STATUS(DIST_OK, dist_render(ctx, &real, &cameras[v], &how, &out, NULL), ctx);
            tapes[v] = dist_tape_create(ctx, &cameras[v], &how);
        }
        out.color = color;
        d_out.color = d_color;
        for (int step = 0; step < STEPS; step++) {
            float g[4] = {0, 0, 0, 0};
            double loss = 0.0;
            dist_gradients grads;
            memset(&grads, 0, sizeof grads);
            grads.code = g;
            for (int v = 0; v < 2; v++) {
                memset(d_color, 0, sizeof d_color);
                CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &cameras[v], &how, &out, tapes[v]), ctx);
                loss += (double)dist_loss_color(N, color, photo[v], NULL, 1.0f, d_color);
                CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tapes[v], &d_out, &grads), ctx);
            }
            if (!relaxed)
                for (int k = 0; k < 4; k++) CHECK_NEAR(0.0, g[k], 0.0);
            if (test_state.verbose && step % 30 == 0)
                printf("    step %d: loss %.5f, code %.4f %.4f %.4f %.4f\n", step, loss, (double)code[0],
                       (double)code[1], (double)code[2], (double)code[3]);
            adam.rate = 0.02f * (float)pow(0.02, (double)step / STEPS);
            dist_adam_step(&adam, 4, code, g);
        }
        for (int k = 0; relaxed && k < 4; k++) CHECK_NEAR(truth[k], code[k], 0.01);
        dist_tape_destroy(tapes[0]);
        dist_tape_destroy(tapes[1]);
        dist_context_destroy(ctx);
    }
}

TEST(outline_gradient_has_the_same_bits_for_every_number_of_workers)
{
    static const int counts[3] = {1, 2, 7};
    float code[4] = {0.1f, -0.05f, 0.05f, 0.6f};
    result first, got;
    for (int i = 0; i < 3; i++) {
        test_scheduler scheduler;
        dist_context_desc desc = test_context_desc();
        memset(&scheduler, 0, sizeof scheduler);
        scheduler.workers = desc.workers = counts[i];
        desc.scheduler = test_scheduler_hook(&scheduler);
        dist_context *ctx = dist_context_create(&desc);
        dist_field field = flat_sphere(code);
        dist_camera camera = camera_at(SIDE, 0.4);
        dist_render_desc how = outline_how(3.0f * pixel_width(&camera));
        dist_tape_destroy(outline_backward(ctx, &field, &camera, &how, &got));
        if (i == 0) first = got;
        CHECK_BYTES(offsetof(result, grads), &first, &got);
        dist_context_destroy(ctx);
    }
}

TEST(an_adjoint_of_a_color_that_is_none_is_refused)
{
    float code[4] = {0, 0, 0, 0.5f}, depth[16], d_color[48] = {1};
    dist_context *ctx = test_context();
    dist_field field = flat_sphere(code);
    dist_camera camera = camera_at(4, 0.0);
    dist_render_desc how = outline_how(0.1f);
    dist_images out, d_out;
    dist_gradients grads;
    float d_code[4] = {0, 0, 0, 0};
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    out.depth = depth;
    d_out.color = d_color;
    grads.code = d_code;
    field.color_fn = NULL;
    CHECK(field.color_adjoint_fn != NULL);
    dist_tape *tape = dist_tape_create(ctx, &camera, &how);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, tape), ctx);
    CHECK_STATUS(DIST_UNSUPPORTED, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
    CHECK_TEXT("dist_render_backward: the field has no color", dist_context_message(ctx));
    dist_tape_destroy(tape);
    dist_context_destroy(ctx);
}

TEST(a_band_that_is_no_length_is_refused)
{
    static const uint32_t wrong[3] = {0xbf800000u, 0x7fc00000u, 0x7f800000u}; /* -1, NaN, infinity */
    float code[4] = {0, 0, 0, 0.5f}, depth[16];
    dist_context *ctx = test_context();
    dist_field field = flat_sphere(code);
    dist_camera camera = camera_at(4, 0.0);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = depth;
    for (int i = 0; i < 3; i++) {
        dist_render_desc how = outline_how(0.0f);
        memcpy(&how.relax_band, &wrong[i], sizeof how.relax_band);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        CHECK(dist_tape_create(ctx, &camera, &how) == NULL);
        dist_context_clear(ctx);
    }
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(outline_seeds_are_what_the_equation_says);
    RUN(outline_gradient_is_the_derivative_of_the_area_but_for_the_bands_width);
    RUN(a_sphere_is_found_by_its_color_alone);
    RUN(outline_gradient_has_the_same_bits_for_every_number_of_workers);
    RUN(an_adjoint_of_a_color_that_is_none_is_refused);
    RUN(a_band_that_is_no_length_is_refused);
    return test_report();
}
