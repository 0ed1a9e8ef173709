/* SPDX-License-Identifier: MIT-0
   test_weights.c - a decoder learns from images alone: the weights' gradient through depth, silhouette, normals */
#include "test.h"

enum { VIEWS = 8, SIDE = 24, PIXELS = SIDE * SIDE };

/* What a camera saw of the true shape. */
typedef struct photo {
    dist_camera camera;
    float depth[PIXELS], normal[3 * PIXELS];
    unsigned char mask[PIXELS];
} photo;

/* Cameras around the shape, some from above and some from below. */
static dist_camera photo_camera(double turn, double height)
{
    float eye[3] = {(float)(2.2 * cos(turn)), (float)height, (float)(2.2 * sin(turn))};
    float at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    return dist_camera_look_at(SIDE, SIDE, 0.8f, eye, at, up);
}

static void photo_take(dist_context *ctx, const dist_field *field, photo *p)
{
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = p->depth;
    out.normal = p->normal;
    out.mask = p->mask;
    CHECK_STATUS(DIST_OK, dist_render(ctx, field, &p->camera, NULL, &out, NULL), ctx);
}

/* Intersection over union of the masks, and the mean difference of depth where both are hit. */
static double photo_compare(dist_context *ctx, const dist_field *field, const photo *p, double *depth)
{
    static photo mine;
    double both = 0.0, either = 0.0, sum = 0.0;
    mine.camera = p->camera;
    photo_take(ctx, field, &mine);
    for (int i = 0; i < PIXELS; i++) {
        either += p->mask[i] || mine.mask[i];
        if (!p->mask[i] || !mine.mask[i]) continue;
        both += 1.0;
        sum += fabs((double)p->depth[i] - (double)mine.depth[i]);
    }
    *depth = both > 0.0 ? sum / both : 1e30;
    return either > 0.0 ? both / either : 0.0;
}

typedef struct training {
    const char *name;
    int activation;
    float scale;
    float rate;
    int width, steps, normals; /* normals: also the normal plane, by differences */
    double iou, depth;  /* what must be reached on every view */
} training;

/* Adam on all weights; two of the eight views a step, by turns. */
static void train(const training *how)
{
    static photo seen[VIEWS + 1], mine;
    static float silhouette[PIXELS], d_depth[PIXELS], d_silhouette[PIXELS], d_normal[3 * PIXELS];
    float ring[5] = {0.0f, 0.0f, 0.0f, 0.55f, 0.22f}, points[3 * 256];
    dist_context *ctx = test_context();
    dist_field truth = dist_field_torus(ring);
    dist_net_desc desc;
    dist_render_desc render;
    dist_images out, d_out;
    dist_adam adam;
    dist_gradients grads;
    test_random random = test_random_seed(8);
    memset(&desc, 0, sizeof desc);
    memset(&render, 0, sizeof render);
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&adam, 0, sizeof adam);
    memset(&grads, 0, sizeof grads);
    for (int i = 0; i <= VIEWS; i++) { /* the last one is not learned from */
        seen[i].camera = photo_camera(0.3 + 6.2831853 * i / VIEWS + (i == VIEWS ? 0.4 : 0.0), i % 2 ? 1.3 : -1.1);
        photo_take(ctx, &truth, &seen[i]);
    }
    desc.layers = 3;
    desc.width = how->width;
    desc.activation = how->activation;
    desc.scale = how->scale;
    desc.output_linear = 1;
    desc.geometric = how->activation != DIST_ACTIVATION_SINE;
    desc.seed = 8;
    dist_net *net = dist_net_create(ctx, &desc);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    size_t n = dist_net_weight_count(net);
    float *weights = (float *)malloc(n * sizeof(float)), *d_weights = (float *)malloc(n * sizeof(float));
    adam.moments = (float *)calloc(2 * n, sizeof(float));
    REQUIRE(shape && weights && d_weights && adam.moments);
    memcpy(weights, dist_net_weights(net), n * sizeof(float));
    grads.weights = d_weights;
    render.gradient = DIST_GRADIENT_IMPLICIT;
    render.normal_mode = DIST_NORMAL_DIFFERENCE;
    render.normal_delta = 1e-2f;
    out.depth = mine.depth;
    out.mask = mine.mask;
    out.silhouette = silhouette;
    d_out.depth = d_depth;
    d_out.silhouette = d_silhouette;
    if (how->normals) {
        out.normal = mine.normal;
        d_out.normal = d_normal;
    }
    dist_tape *tape = dist_tape_create(ctx, &seen[0].camera, &render);
    double first = 0.0, last = 0.0, sum = 0.0, depth;
    for (int step = 0; step < how->steps; step++) {
        memset(d_weights, 0, n * sizeof(float));
        float loss = 0.0f;
        for (int k = 0; k < 2; k++) {
            const photo *p = &seen[(2 * step + k) % VIEWS];
            memset(d_depth, 0, sizeof d_depth);
            memset(d_silhouette, 0, sizeof d_silhouette);
            memset(d_normal, 0, sizeof d_normal);
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &p->camera, &render, &out, tape), ctx);
            loss += dist_loss_depth(PIXELS, mine.depth, p->depth, mine.mask, 1.0f, d_depth);
            loss += dist_loss_silhouette(PIXELS, silhouette, p->mask, 20.0f, d_silhouette);
            if (how->normals) loss += dist_loss_normal(PIXELS, mine.normal, p->normal, p->mask, 0.02f, d_normal);
            CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
        }
        test_random_fill(&random, 3 * 256, points, -0.8f, 0.8f);
        float eikonal = 0.0f;
        CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, 256, points, 0.1f, &eikonal, &grads), ctx);
        sum += (double)(loss + eikonal);
        if (step % 50 == 49) {
            if (step == 49) first = sum / 50;
            last = sum / 50;
            sum = 0.0;
            if (test_state.verbose) printf("    %s, step %d: loss %.4f\n", how->name, step + 1, last);
        }
        adam.rate = how->rate * (float)pow(0.03, (double)step / how->steps);
        CHECK_EQUAL(0, dist_adam_step(&adam, n, weights, d_weights));
        CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, weights), ctx);
        CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, NULL), ctx);
    }
    for (int i = 0; i <= VIEWS; i++) {
        double iou = photo_compare(ctx, &field, &seen[i], &depth);
        if (test_state.verbose) printf("    %s, view %d: IoU %.4f, depth error %.5f\n", how->name, i, iou, depth);
        CHECK(iou >= how->iou);
        CHECK(depth <= how->depth);
    }
    CHECK(last < 0.2 * first);
    dist_tape_destroy(tape);
    free(weights);
    free(d_weights);
    free(adam.moments);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(a_softplus_net_learns_a_torus_from_8_silhouettes_and_depths)
{
    if (test_quick()) SKIP("a softplus net takes ten seconds");
    training how = {"softplus", DIST_ACTIVATION_SOFTPLUS, 20.0f, 6e-3f, 24, 300, 0, 0.93, 0.025};
    train(&how);
}

TEST(a_relu_net_learns_a_torus_from_8_silhouettes_and_depths)
{
    training how = {"relu", DIST_ACTIVATION_RELU, 0.0f, 4e-3f, 32, 400, 0, 0.93, 0.02};
    train(&how);
}

TEST(a_relu_net_learns_a_torus_from_normals_as_well)
{
    training how = {"relu, normals", DIST_ACTIVATION_RELU, 0.0f, 4e-3f, 32, 400, 1, 0.93, 0.02};
    train(&how);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(a_softplus_net_learns_a_torus_from_8_silhouettes_and_depths);
    RUN(a_relu_net_learns_a_torus_from_8_silhouettes_and_depths);
    RUN(a_relu_net_learns_a_torus_from_normals_as_well);
    return test_report();
}
